//! Whether somebody is there to connect to.

use std::io::ErrorKind;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::time::timeout;
use zenoh::Session;

use super::Findings;
use crate::{Endpoints, open_session};

/// A connection across the world takes half a second.
const CONNECT: Duration = Duration::from_secs(3);
/// The same with what Zenoh, and perhaps TLS, have to say to each other.
const SESSION: Duration = Duration::from_secs(5);

/// Connects to the endpoint that is to be connected to, first by TCP alone, then with Zenoh; gives the session if there is
/// one.
///
/// Needs a multi-thread tokio runtime.
pub async fn reach(findings: &mut Findings, endpoints: &Endpoints) -> Option<Session> {
    let endpoint = endpoints.connect.first()?;
    let address = address(endpoint);
    let connected = match timeout(CONNECT, TcpStream::connect(address)).await {
        Ok(connected) => connected.map_err(|error| (error.to_string(), hint(error.kind()))),
        Err(_) => Err((format!("no answer within {CONNECT:?}"), hint(ErrorKind::TimedOut))),
    };
    if let Err((reason, hint)) = connected {
        findings.fail("connection", format!("{address}: {reason}"), hint);
        return None;
    }
    let (reason, hint) = match timeout(SESSION, open_session(endpoints)).await {
        Ok(Ok(session)) => {
            findings.ok("connection", format!("{endpoint} is there, and speaks Zenoh"));
            return Some(session);
        }
        Ok(Err(error)) => (format!("{endpoint}: {error}"), "the endpoint must be one of a learner or a Zenoh router"),
        Err(_) => (
            format!("something listens at {address}, but there is no Zenoh session with it after {SESSION:?}"),
            "is it a learner or a Zenoh router, of the same protocol (tcp or tls), and are its certificates of the same authority?",
        ),
    };
    findings.fail("connection", reason, hint);
    None
}

/// HOST:PORT of an endpoint, which begins with its protocol and may end in options.
fn address(endpoint: &str) -> &str {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, rest)| rest);
    address.split(['?', '#']).next().unwrap_or(address)
}

fn hint(kind: ErrorKind) -> &'static str {
    match kind {
        ErrorKind::ConnectionRefused => {
            "that machine is there, but nobody listens at this port: is the learner or router started, and does it listen at an address that others reach, like tcp/0.0.0.0:7447, rather than at 127.0.0.1?"
        }
        ErrorKind::TimedOut => "does a firewall drop what goes to this port, or is the address of another network?",
        _ => "is the name spelt right, and is there a network?",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_endpoints() {
        for (endpoint, expected) in [
            ("tcp/127.0.0.1:7447", "127.0.0.1:7447"),
            ("tls/learner.example:7447#iface=eth0", "learner.example:7447"),
            ("tcp/[::1]:7447?prio=1-7", "[::1]:7447"),
        ] {
            assert_eq!(address(endpoint), expected);
        }
    }
}
