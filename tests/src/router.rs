//! A Zenoh router in the test's own process, and a stranger's session on it.

use zenoh::{Config, Session};

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
