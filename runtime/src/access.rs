//! Access control of a learner that listens, by the rules of the router's configuration.

use serde_json::{Value, json};
use zenoh::Config;

const ROUTER: &str = include_str!("../../deploy/zenoh/router-tls.json5");

/// Zenoh's `access_control` for a learner's own session.
///
/// A router lets learners publish and answer. At a learner that listens, no client may do so, whatever
/// its certificate.
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
