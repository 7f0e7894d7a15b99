//! A Zenoh router in the test's own process.

use std::path::Path;

use zenoh::{Config, Session};

use crate::system::free_port;

/// Listens at a port of that address with deploy/zenoh/router-tls.json5 as it is, and with the
/// router's certificate in `certificates`. Gives the endpoint as well.
pub async fn protected_router(address: &str, certificates: &Path) -> (Session, String) {
    let endpoint = format!("tls/{address}:{}", free_port());
    let mut config = listening("router-tls.json5", &endpoint);
    for (setting, file) in [
        ("root_ca_certificate", "ca.pem"),
        ("listen_certificate", "cert.pem"),
        ("listen_private_key", "key.pem"),
    ] {
        let (setting, path) = (format!("transport/link/tls/{setting}"), certificates.join(file));
        config.insert_json5(&setting, &format!("{path:?}")).expect("the setting exists");
    }
    (zenoh::open(config).await.expect("the port is free"), endpoint)
}

/// Listens at `endpoint` with deploy/zenoh/router.json5; the test itself may speak through it.
pub async fn router(endpoint: &str) -> Session {
    zenoh::open(listening("router.json5", endpoint)).await.expect("the port is free")
}

/// Opens a router that passes on no scores: however fast a machine is, no job is over before a test
/// lets something happen to it. A learner that listens itself is one to `connect` to.
pub async fn router_without_scores(endpoint: &str, connect: Option<&str>) -> Session {
    let mut config = listening("router.json5", endpoint);
    let connect: Vec<&str> = connect.into_iter().collect();
    config.insert_json5("connect/endpoints", &format!("{connect:?}")).expect("the setting exists");
    let filter = r#"[{ flows: ["ingress"], messages: ["query"], key_exprs: ["quad/*/scores"], size_limit: 0 }]"#;
    config.insert_json5("low_pass_filter", filter).expect("the setting exists");
    zenoh::open(config).await.expect("the port is free")
}

/// A configuration of deploy/zenoh, listening there.
fn listening(file: &str, endpoint: &str) -> Config {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/zenoh").join(file);
    let mut config = Config::from_file(file).expect("Zenoh understands the configuration");
    let endpoints = format!("[{endpoint:?}]");
    config.insert_json5("listen/endpoints", &endpoints).expect("the setting exists");
    config
}
