//! A Zenoh router in the test's own process, and a stranger's session on it.

use std::path::Path;

use zenoh::{Config, Session};

use crate::system::free_port;

/// Listens at a port of its own with deploy/zenoh/router-tls.json5 as it is, and with the router's certificate in
/// `certificates`. Gives the endpoint as well.
pub async fn protected_router(certificates: &Path) -> (Session, String) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/zenoh/router-tls.json5");
    let mut config = Config::from_file(file).expect("Zenoh understands the router's configuration");
    let endpoint = format!("tls/127.0.0.1:{}", free_port());
    config.insert_json5("listen/endpoints", &format!("[{endpoint:?}]")).expect("the setting exists");
    let files =
        [("root_ca_certificate", "ca.pem"), ("listen_certificate", "cert.pem"), ("listen_private_key", "key.pem")];
    for (setting, file) in files {
        let path = format!("{:?}", certificates.join(file));
        config.insert_json5(&format!("transport/link/tls/{setting}"), &path).expect("the setting exists");
    }
    (zenoh::open(config).await.expect("the port is free"), endpoint)
}

/// Listens at `endpoint` as the router program does, and lets the test itself speak to everybody behind it.
pub async fn router(endpoint: &str) -> Session {
    let mut config = Config::default();
    let settings = [
        ("mode", "\"router\"".to_owned()),
        ("listen/endpoints", format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value).expect("the setting exists");
    }
    zenoh::open(config).await.expect("the port is free")
}
