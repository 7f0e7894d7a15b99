//! A Zenoh router in this process, at which many learners and evaluators of one machine meet.

use serde_json::json;
use zenoh::{Config, Session};

use crate::endpoints::{Endpoints, SessionError};
use crate::session::{for_people, reachable_at};

const SETTINGS: &str = include_str!("../../deploy/zenoh/router.json5");
/// Loopback; the system chooses the port.
const LISTEN: &str = "tcp/127.0.0.1:0";

/// Opens a router, which lives as long as the session, and returns its endpoint. Needs a multi-thread
/// tokio runtime.
pub async fn open_router() -> Result<(Session, String), SessionError> {
    let wrong =
        |error| SessionError::Endpoint { endpoints: LISTEN.to_owned(), reason: for_people(error) };
    let session = zenoh::open(config().map_err(wrong)?).await.map_err(wrong)?;
    let endpoints = Endpoints { listen: vec![LISTEN.to_owned()], ..Endpoints::default() };
    let bound = reachable_at(&session, &endpoints).await?;
    let endpoint = bound.into_iter().next().ok_or(SessionError::Unknown)?;
    Ok((session, endpoint))
}

fn config() -> zenoh::Result<Config> {
    let mut config = Config::from_json5(SETTINGS)?;
    config.insert_json5("listen/endpoints", &json!([LISTEN]).to_string())?;
    // Makes the session report which port the system has chosen.
    config.insert_json5("adminspace/enabled", "true")?;
    Ok(config)
}
