//! Where learner and evaluators meet, as a person writes it: Zenoh's endpoints.

use zenoh::config::EndPoint;

use crate::certificates::{Certificates, is_this_machine};

/// The protocols that Zenoh is built with here: neither encrypted nor authenticated, and both.
const OPEN: &str = "tcp/";
const PROTECTED: &str = "tls/";

/// Where a session meets the others, as Zenoh's endpoints: `tcp/127.0.0.1:7447`, or with certificates
/// `tls/127.0.0.1:7447`.
///
/// There is no scouting: only the endpoints named here are used. A session that listens is a peer, to which clients connect
/// directly; one that does not is a client of the peer or router that it connects to.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Endpoints {
    /// Listen here. Port 0 takes a free one; [`reachable_at`](crate::reachable_at) tells which.
    pub listen: Vec<String>,
    /// Connect to these. A client keeps one connection: to reach several learners or routers, open a session for each.
    pub connect: Vec<String>,
    /// With them, every connection is by TLS, and both sides show a certificate. A client of a session that listens may
    /// do what deploy/zenoh/router-tls.json5 allows its role.
    pub certificates: Option<Certificates>,
}

/// There is no session, or it does not answer.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// Nothing to listen at and nothing to connect to.
    #[error("no endpoint to listen at or to connect to")]
    NoEndpoint,
    /// Not an endpoint that this program can use. Zenoh would try for ever to connect to one of another protocol.
    #[error("{endpoint:?} is not an endpoint; write it like {OPEN}127.0.0.1:7447 or {PROTECTED}127.0.0.1:7447")]
    NotAnEndpoint {
        /// What was given.
        endpoint: String,
    },
    /// Certificates are there, but would not be used.
    #[error("certificates are given, but the connection at {endpoint} would not be encrypted")]
    Open {
        /// The endpoint.
        endpoint: String,
    },
    /// Certificates are not there, but would be needed.
    #[error("{endpoint} needs certificates")]
    NoCertificates {
        /// The endpoint.
        endpoint: String,
    },
    /// It cannot be listened at, or its options are wrong.
    #[error("cannot use the Zenoh endpoint {endpoints}: {reason}")]
    Endpoint {
        /// The endpoints.
        endpoints: String,
        /// Zenoh's own words.
        reason: String,
    },
    /// The session does not tell which endpoints it has bound.
    #[error("the Zenoh session does not tell where it listens")]
    Unknown,
}

impl SessionError {
    /// What to do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            SessionError::Open { .. } => "write the endpoint like tls/HOST:PORT, or leave --certificates away",
            SessionError::NoCertificates { .. } => {
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
    /// Tells early what [`open_session`](crate::open_session) would refuse.
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
                (false, Some(_)) => return Err(SessionError::Open { endpoint }),
                (true, None) => return Err(SessionError::NoCertificates { endpoint }),
                _ => {}
            }
        }
        Ok(())
    }

    /// The endpoint at which other machines may connect without a certificate, if there is one.
    pub fn open_to_all(&self) -> Option<&str> {
        self.for_others().filter(|_| self.certificates.is_none())
    }

    /// The endpoint for other machines at which all of them would refuse its certificate, if there is one: the certificate
    /// names only this machine's names for itself.
    pub(crate) fn closed_to_all(&self) -> Option<&str> {
        self.for_others().filter(|_| self.certificates.as_ref().is_some_and(Certificates::is_for_this_machine_alone))
    }

    /// The first endpoint that it listens at for other machines, so not on loopback.
    fn for_others(&self) -> Option<&str> {
        let is_local = |endpoint: &&String| {
            let address = address_of(endpoint);
            let host = address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
            is_this_machine(host)
        };
        self.listen.iter().find(|endpoint| !is_local(endpoint)).map(String::as_str)
    }
}

/// Where learner and evaluator of one machine meet by default.
pub fn default_endpoint(certificates: Option<&Certificates>, port: u16) -> String {
    format!("{}127.0.0.1:{port}", if certificates.is_some() { PROTECTED } else { OPEN })
}

/// Checks an endpoint that a person wrote, and gives it back as it is: a `value_parser` for a command line.
///
/// # Errors
///
/// [`SessionError::NotAnEndpoint`]: it is malformed, or names another protocol than TCP and TLS.
pub fn parse_endpoint(text: &str) -> Result<String, SessionError> {
    if [OPEN, PROTECTED].iter().any(|protocol| text.starts_with(protocol)) && text.parse::<EndPoint>().is_ok() {
        return Ok(text.to_owned());
    }
    Err(SessionError::NotAnEndpoint { endpoint: text.to_owned() })
}

/// HOST:PORT of an endpoint, between its protocol and its options: `tcp/127.0.0.1:0#iface=lo`.
pub(crate) fn address_of(endpoint: &str) -> &str {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, rest)| rest);
    address.split(['?', '#']).next().unwrap_or(address)
}

/// Whether the system is to choose the endpoint's port.
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
        for endpoint in ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:0", "tcp/127.1.2.3:1#iface=lo"] {
            assert_eq!(open(endpoint), None, "{endpoint}");
        }
        for endpoint in ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/192.0.2.1:0", "tcp/learner:1?prio=1-7"] {
            assert_eq!(open(endpoint).as_deref(), Some(endpoint));
        }
    }

    #[test]
    fn which_ports_the_system_chooses() {
        for endpoint in ["tcp/127.0.0.1:0", "tcp/[::1]:0", "tcp/0.0.0.0:0#iface=lo", "tcp/127.0.0.1:0?prio=1-7"] {
            assert!(leaves_port_open(endpoint), "{endpoint}");
        }
        for endpoint in ["tcp/127.0.0.1:7447", "tcp/learner:10", "tcp/[::0]:7447", "tcp/127.0.0.1:7447#iface=e:0"] {
            assert!(!leaves_port_open(endpoint), "{endpoint}");
        }
    }
}
