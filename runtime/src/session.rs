//! The connection between learner and evaluators over Zenoh, and a router at which many of one machine
//! meet.

use std::thread;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::sync::oneshot;
use tokio::time::timeout;
use tracing::warn;
use zenoh::{Config, Session, Wait};

use crate::endpoints::{Endpoints, SessionError};
use crate::threads::stay_in_background;

/// Settings of a router without and with certificates.
const ROUTER: &str = include_str!("../../deploy/zenoh/router.json5");
const ROUTER_TLS: &str = include_str!("../../deploy/zenoh/router-tls.json5");
/// Loopback; the system chooses the port.
const ANY_PORT: &str = "tcp/127.0.0.1:0";

/// Time after which a frozen or disconnected process counts as gone: half of Zenoh's default, but long
/// enough for a busy machine that misses several keep-alive messages.
const LEASE: Duration = Duration::from_secs(5);
/// Largest message that a client accepts, bytes: the largest snapshot (64 MiB) and Zenoh's overhead.
const MAX_SNAPSHOT_SIZE: u64 = 65 << 20;
/// Largest fragmented message that a listening session accepts, bytes. Zenoh keeps each fragment in its
/// buffer of 64 KiB until the last one arrives, so fragments of one byte could fill any memory.
/// Evaluators' messages have at most 30 KiB, and a packet has space for 32,700 bytes.
const MAX_FRAGMENTED: u64 = 0;
/// Most connections of a listening session. Each is an open file, and many systems limit a process to
/// 1024. The rest is for datasets, logs and metrics.
const MAX_SESSIONS: u64 = 768;
const DROP_WAIT: &str =
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments";
const BLOCK_WAIT: &str = "transport/link/tx/queue/congestion_control/block/wait_before_close";
/// First and longest pause between two attempts to connect.
const RETRY: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(2)];
/// Time that a droppable large message waits for a slow receiver. Zenoh's 50 ms are too short for a
/// snapshot when training uses all cores; a receiver that hangs must not delay the others for long.
const DROP_AFTER: Duration = Duration::from_millis(500);
/// Time that any other message waits for a receiver before its connection is closed. Other receivers
/// may wait meanwhile, so this is less than Zenoh's five seconds; it suffices for a packet of 64 KiB at
/// 256 kbit/s.
const CLOSE_AFTER: Duration = Duration::from_secs(2);
/// Time without a connection after which a client logs a warning.
const PATIENCE: Duration = Duration::from_secs(10);
/// Time limit when a session asks itself for its endpoints, which needs no network.
const SELF_QUERY_TIMEOUT: Duration = Duration::from_secs(5);

/// Opens a session. Needs a multi-thread tokio runtime.
///
/// A client waits for a learner or router that has not started yet, until this future is dropped. If
/// the connection is lost later, the client connects again.
pub async fn open_session(endpoints: &Endpoints) -> Result<Session, SessionError> {
    endpoints.check()?;
    if let Some(endpoint) = endpoints.closed_to_all() {
        warn!(
            "{endpoint} is for other machines, but they will refuse the certificate, which does not name this machine as they do; \
             make one with deploy/zenoh/certificates.sh learner NAME HOST"
        );
    }
    let wrong = |error| {
        let endpoints = [&endpoints.listen[..], &endpoints.connect].concat().join(", ");
        let reason = for_people(error);
        SessionError::Endpoint { endpoints, reason }
    };
    let config = config(endpoints).map_err(wrong)?;
    // Zenoh's future blocks its thread until there is a connection. Nothing joins the new thread: if
    // this future is dropped, the process can end.
    let (tx, mut rx) = oneshot::channel();
    let open = move || {
        // This thread starts Zenoh's own threads, which inherit its priority.
        stay_in_background();
        drop(tx.send(zenoh::open(config).wait()));
    };
    thread::Builder::new()
        .name("zenoh-open".to_owned())
        .spawn(open)
        .map_err(|error| wrong(error.into()))?;
    let opened = match timeout(PATIENCE, &mut rx).await {
        Ok(opened) => opened,
        Err(_) => {
            warn!(
                "no connection to {} yet: no learner or router is there, or one of the two refuses the other's certificate; \
                 `learner doctor` or `evaluator doctor` with this --connect finds out, \
                 RUST_LOG=zenoh::net::runtime=debug logs each try",
                endpoints.connect.join(", ")
            );
            rx.await
        }
    };
    opened.map_err(|error| wrong(error.into()))?.map_err(wrong)
}

fn config(endpoints: &Endpoints) -> zenoh::Result<Config> {
    let listens = !endpoints.listen.is_empty();
    let (mode, max_message_size) = match listens {
        true => ("peer", MAX_FRAGMENTED),
        false => ("client", MAX_SNAPSHOT_SIZE),
    };
    let retry = RETRY.map(|pause| pause.as_millis() as u64);
    let mut settings = vec![
        ("mode", json!(mode)),
        ("listen/endpoints", json!(endpoints.listen)),
        ("connect/endpoints", json!(endpoints.connect)),
        // A client waits for a learner or router; by default it would give up at once.
        ("connect/timeout_ms", json!(-1)),
        ("connect/exit_on_failure", json!(false)),
        ("connect/retry", json!({ "period_init_ms": retry[0], "period_max_ms": retry[1] })),
        ("scouting/multicast/enabled", json!(false)),
        ("scouting/gossip/enabled", json!(false)),
        ("transport/link/tx/lease", json!(LEASE.as_millis() as u64)),
        (DROP_WAIT, json!(DROP_AFTER.as_micros() as u64)),
        (BLOCK_WAIT, json!(CLOSE_AFTER.as_micros() as u64)),
        ("transport/link/rx/max_message_size", json!(max_message_size)),
        ("transport/unicast/max_sessions", json!(MAX_SESSIONS)),
        // This is the only stable way to learn a port that the system chose. Clients could read the
        // configuration there, so it is on only if needed.
        ("adminspace/enabled", json!(endpoints.has_open_port())),
    ];
    if let Some(certificates) = &endpoints.certificates {
        settings.push(("transport/link/tls", certificates.settings()));
        if listens {
            settings.push(("access_control", access_control()?));
            // The largest message of each kind.
            settings.push(("low_pass_filter", router_setting("low_pass_filter")?));
        }
    }
    let mut config = Config::default();
    for (key, value) in settings {
        config.insert_json5(key, &value.to_string())?;
    }
    Ok(config)
}

/// Zenoh's `access_control` for a learner's own session.
///
/// A router lets learners publish and answer. At a learner that listens, no client may do so, whatever
/// its certificate.
fn access_control() -> zenoh::Result<Value> {
    let mut rules = router_setting("access_control")?;
    if let Some(policies) = rules["policies"].as_array_mut() {
        policies.retain(|policy| policy["subjects"] != json!(["learner"]));
    }
    Ok(rules)
}

fn router_setting(key: &str) -> zenoh::Result<Value> {
    Ok(serde_json::from_str(&Config::from_json5(ROUTER_TLS)?.get_json(key)?)?)
}

/// Opens a router, which lives as long as the session, and returns its endpoint. Needs a multi-thread
/// tokio runtime.
pub async fn open_router() -> Result<(Session, String), SessionError> {
    let wrong = |error| {
        let (endpoints, reason) = (ANY_PORT.to_owned(), for_people(error));
        SessionError::Endpoint { endpoints, reason }
    };
    let session = zenoh::open(router_config().map_err(wrong)?).await.map_err(wrong)?;
    let bound = locators(&session).await.unwrap_or_default();
    let endpoint = bound.into_iter().next().ok_or(SessionError::Unknown)?;
    Ok((session, endpoint))
}

fn router_config() -> zenoh::Result<Config> {
    let mut config = Config::from_json5(ROUTER)?;
    config.insert_json5("listen/endpoints", &json!([ANY_PORT]).to_string())?;
    // Makes the session report which port the system has chosen.
    config.insert_json5("adminspace/enabled", "true")?;
    Ok(config)
}

/// Zenoh's error message without the places in its source code (`at /…/tcp.rs:61.`).
fn for_people(error: zenoh::Error) -> String {
    let text = error.to_string();
    let mut words = text.split(' ').peekable();
    let mut plain = String::new();
    while let Some(word) = words.next() {
        match words.next_if(|next| word == "at" && next.contains(".rs:")) {
            Some(place) => plain.extend(place.chars().rev().take_while(|&c| c == ']')),
            None if plain.is_empty() => plain.push_str(word),
            None => plain.extend([" ", word]),
        }
    }
    plain
}

/// The endpoints for evaluators of `session`, which was opened with `endpoints`: those at which it
/// listens, with the ports that the system chose; if it does not listen, those to which it connects.
pub async fn reachable_at(
    session: &Session,
    endpoints: &Endpoints,
) -> Result<Vec<String>, SessionError> {
    if endpoints.listen.is_empty() {
        return Ok(endpoints.connect.clone());
    }
    if !endpoints.has_open_port() {
        return Ok(endpoints.listen.clone());
    }
    let bound = locators(session).await.unwrap_or_default();
    if bound.is_empty() { Err(SessionError::Unknown) } else { Ok(bound) }
}

/// The endpoints that a session has bound, by a query to itself.
async fn locators(session: &Session) -> zenoh::Result<Vec<String>> {
    let query = session.get(format!("@/{}/*", session.zid())).timeout(SELF_QUERY_TIMEOUT);
    let reply = query.await?.recv_async().await?;
    let sample = reply.result().map_err(|_| "no answer")?;
    let description: Value = serde_json::from_slice(&sample.payload().to_bytes())?;
    let locators = description["locators"].as_array().into_iter().flatten();
    Ok(locators.filter_map(Value::as_str).map(str::to_owned).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_without_places() {
        let text =
            "Can not listen: [In use (os error 98) at /a/src/tcp.rs:61.] at /a/src/unicast.rs:338.";
        assert_eq!(for_people(text.into()), "Can not listen: [In use (os error 98)]");
        assert_eq!(for_people("No route to host".into()), "No route to host");
    }
}
