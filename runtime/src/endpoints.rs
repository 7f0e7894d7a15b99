//! Zenoh endpoints as a user writes them: where learner and evaluators meet.

use zenoh::config::EndPoint;

use crate::certificates::{Certificates, is_this_machine};

/// The two protocols that this program's Zenoh supports: without and with encryption and
/// authentication.
const OPEN: &str = "tcp/";
const PROTECTED: &str = "tls/";

/// The endpoints of a session: `tcp/127.0.0.1:7447`, or with certificates `tls/127.0.0.1:7447`.
///
/// There is no scouting: a session uses only the endpoints named here. A session that listens is a
/// peer, to which clients connect directly. A session that does not listen is a client of the peer
/// or router that it connects to.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Endpoints {
    /// Listen here. Port 0 takes a free port; [`reachable_at`](crate::reachable_at) returns it.
    pub listen: Vec<String>,
    /// Connect to these. A client keeps one connection, so a program that must reach several
    /// learners or routers opens a session for each.
    pub connect: Vec<String>,
    /// With certificates, every connection uses TLS, and both sides show a certificate. A client of
    /// a session that listens may do what deploy/zenoh/router-tls.json5 allows its role.
    pub certificates: Option<Certificates>,
}

/// Why there is no session.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The endpoints name neither a place to listen at nor one to connect to.
    #[error("no endpoint to listen at or to connect to")]
    NoEndpoint,
    /// This program cannot use the endpoint. (Zenoh would try for ever to connect by an unknown
    /// protocol.)
    #[error(
        "{0:?} is not an endpoint; write it like {OPEN}127.0.0.1:7447 or {PROTECTED}127.0.0.1:7447"
    )]
    NotAnEndpoint(String),
    /// There are certificates, but the endpoint would not use them.
    #[error("certificates are given, but the connection at {0} would not be encrypted")]
    Open(String),
    /// The endpoint needs certificates, but there are none.
    #[error("{0} needs certificates")]
    NoCertificates(String),
    /// The session cannot listen at the endpoints, or their options are wrong.
    #[error("cannot use the Zenoh endpoint {endpoints}: {reason}")]
    Endpoint {
        /// The endpoints.
        endpoints: String,
        /// Zenoh's error message.
        reason: String,
    },
    /// The session does not say which endpoints it has bound.
    #[error("the Zenoh session does not tell where it listens")]
    Unknown,
}

impl SessionError {
    /// What to do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            SessionError::Open(_) => {
                "write the endpoint like tls/HOST:PORT, or leave --certificates away"
            }
            SessionError::NoCertificates(_) => {
                "name their folder by --certificates DIR or QUAD_CERTIFICATES; deploy/zenoh/certificates.sh makes one"
            }
            _ => {
                "if the port is taken, perhaps by another learner, choose a free one with --listen tcp/127.0.0.1:0, \
                 or join a router with --connect"
            }
        }
    }
}

impl Endpoints {
    /// Checks early for what [`open_session`](crate::open_session) would refuse.
    ///
    /// # Errors
    ///
    /// No endpoint, or a malformed one; tcp/ with certificates, and tls/ without.
    pub fn check(&self) -> Result<(), SessionError> {
        if self.listen.is_empty() && self.connect.is_empty() {
            return Err(SessionError::NoEndpoint);
        }
        for endpoint in self.listen.iter().chain(&self.connect) {
            let endpoint = parse_endpoint(endpoint)?;
            match (endpoint.starts_with(PROTECTED), &self.certificates) {
                (false, Some(_)) => return Err(SessionError::Open(endpoint)),
                (true, None) => return Err(SessionError::NoCertificates(endpoint)),
                _ => {}
            }
        }
        Ok(())
    }

    /// The endpoint at which other machines may connect without a certificate, if there is one.
    pub fn open_to_all(&self) -> Option<&str> {
        self.for_others().filter(|_| self.certificates.is_none())
    }

    /// The endpoint for other machines whose certificate all of them would refuse, if there is one:
    /// the certificate contains only names that this machine has for itself.
    pub(crate) fn closed_to_all(&self) -> Option<&str> {
        self.for_others().filter(|_| {
            self.certificates.as_ref().is_some_and(Certificates::is_for_this_machine_alone)
        })
    }

    /// The first endpoint to listen at that other machines can reach, so not on loopback.
    fn for_others(&self) -> Option<&str> {
        let is_local = |endpoint: &&String| {
            let address = address_of(endpoint);
            let host =
                address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
            is_this_machine(host)
        };
        self.listen.iter().find(|endpoint| !is_local(endpoint)).map(String::as_str)
    }
}

/// The port at which a learner listens and evaluators look by default.
pub const DEFAULT_PORT: u16 = 7447;

/// The default endpoint at which learner and evaluator of one machine meet.
pub fn default_endpoint(certificates: Option<&Certificates>, port: u16) -> String {
    format!("{}127.0.0.1:{port}", if certificates.is_some() { PROTECTED } else { OPEN })
}

/// Checks an endpoint from the command line and returns it unchanged: a `value_parser`.
///
/// # Errors
///
/// [`SessionError::NotAnEndpoint`]: the endpoint is malformed, or names a protocol other than TCP and TLS.
pub fn parse_endpoint(text: &str) -> Result<String, SessionError> {
    if [OPEN, PROTECTED].iter().any(|protocol| text.starts_with(protocol))
        && text.parse::<EndPoint>().is_ok()
    {
        return Ok(text.to_owned());
    }
    Err(SessionError::NotAnEndpoint(text.to_owned()))
}

/// HOST:PORT of an endpoint, between its protocol and its options: `tcp/127.0.0.1:0#iface=lo`.
pub(crate) fn address_of(endpoint: &str) -> &str {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, rest)| rest);
    address.split(['?', '#']).next().unwrap_or(address)
}

/// Whether the system chooses the endpoint's port.
pub(crate) fn leaves_port_open(endpoint: &str) -> bool {
    address_of(endpoint).ends_with(":0")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_that_other_machines_reach() {
        let open = |endpoint: &str| {
            let listen = vec!["tcp/127.0.0.1:1".to_owned(), endpoint.to_owned()];
            Endpoints { listen, ..Endpoints::default() }.open_to_all().map(str::to_owned)
        };
        for endpoint in
            ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:0", "tcp/127.1.2.3:1#iface=lo"]
        {
            assert_eq!(open(endpoint), None, "{endpoint}");
        }
        for endpoint in
            ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/192.0.2.1:0", "tcp/learner:1?prio=1-7"]
        {
            assert_eq!(open(endpoint).as_deref(), Some(endpoint));
        }
    }

    #[test]
    fn which_ports_the_system_chooses() {
        for endpoint in
            ["tcp/127.0.0.1:0", "tcp/[::1]:0", "tcp/0.0.0.0:0#iface=lo", "tcp/127.0.0.1:0?prio=1-7"]
        {
            assert!(leaves_port_open(endpoint), "{endpoint}");
        }
        for endpoint in [
            "tcp/127.0.0.1:7447",
            "tcp/learner:10",
            "tcp/[::0]:7447",
            "tcp/127.0.0.1:7447#iface=e:0",
        ] {
            assert!(!leaves_port_open(endpoint), "{endpoint}");
        }
    }
}
