//! A Zenoh router in the test's own process.

use std::path::Path;

use zenoh::{Config, Session};

use crate::system::free_port;

/// Listens at a port of that address with deploy/zenoh/router-tls.json5 as it is, and with the
/// router's certificate in `certificates`. Gives the endpoint as well.
pub async fn protected_router(address: &str, certificates: &Path) -> (Session, String) {
    let mut config = configuration("router-tls.json5");
    let endpoint = format!("tls/{address}:{}", free_port());
    config
        .insert_json5("listen/endpoints", &format!("[{endpoint:?}]"))
        .expect("the setting exists");
    let files = [
        ("root_ca_certificate", "ca.pem"),
        ("listen_certificate", "cert.pem"),
        ("listen_private_key", "key.pem"),
    ];
    for (setting, file) in files {
        let path = format!("{:?}", certificates.join(file));
        config
            .insert_json5(&format!("transport/link/tls/{setting}"), &path)
            .expect("the setting exists");
    }
    (zenoh::open(config).await.expect("the port is free"), endpoint)
}

/// Listens at `endpoint` with deploy/zenoh/router.json5; the test itself may speak through it.
pub async fn router(endpoint: &str) -> Session {
    zenoh::open(listening(endpoint)).await.expect("the port is free")
}

/// Opens a router that passes on no scores: however fast a machine is, no job is over before a test
/// lets something happen to it. A learner that listens itself is one to `connect` to.
pub async fn router_without_scores(endpoint: &str, connect: Option<&str>) -> Session {
    let mut config = listening(endpoint);
    let connect: Vec<&str> = connect.into_iter().collect();
    config.insert_json5("connect/endpoints", &format!("{connect:?}")).expect("the setting exists");
    let filter = r#"[{ flows: ["ingress"], messages: ["query"], key_exprs: ["quad/*/scores"], size_limit: 0 }]"#;
    config.insert_json5("low_pass_filter", filter).expect("the setting exists");
    zenoh::open(config).await.expect("the port is free")
}

fn listening(endpoint: &str) -> Config {
    let mut config = configuration("router.json5");
    config
        .insert_json5("listen/endpoints", &format!("[{endpoint:?}]"))
        .expect("the setting exists");
    config
}

fn configuration(file: &str) -> Config {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/zenoh").join(file);
    Config::from_file(file).expect("Zenoh understands the router's configuration")
}
