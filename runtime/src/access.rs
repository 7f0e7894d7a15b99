//! What clients may send to a learner that listens: the rules of the router's configuration.

use serde_json::{Value, json};
use zenoh::Config;

/// The rules are in this file only, for routers and for learners that listen.
const ROUTER: &str = include_str!("../../deploy/zenoh/router-tls.json5");

/// Zenoh's `access_control` for a learner's own session.
///
/// A router lets learners publish and answer. A learner that listens publishes and answers itself,
/// and its access control is only about its clients. So no client may do either, whatever its
/// certificate.
pub(crate) fn rules() -> zenoh::Result<Value> {
    let mut rules = of_router("access_control")?;
    if let Some(policies) = rules["policies"].as_array_mut() {
        policies.retain(|policy| policy["subjects"] != json!(["learner"]));
    }
    Ok(rules)
}

/// Zenoh's `low_pass_filter`: the largest message of each kind.
pub(crate) fn sizes() -> zenoh::Result<Value> {
    of_router("low_pass_filter")
}

fn of_router(key: &str) -> zenoh::Result<Value> {
    Ok(serde_json::from_str(&Config::from_json5(ROUTER)?.get_json(key)?)?)
}
