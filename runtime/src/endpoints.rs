//! Zenoh endpoints as a user writes them: where learner and evaluators meet.

use zenoh::config::EndPoint;

use crate::certificates::{Certificates, is_this_machine};

/// The protocols without and with encryption and authentication.
const OPEN: &str = "tcp/";
const PROTECTED: &str = "tls/";

/// The endpoints of a session: `tcp/127.0.0.1:7447`, or with certificates `tls/127.0.0.1:7447`.
///
/// There is no scouting: a session uses only the endpoints named here. A session that listens is a
/// peer, any other a client of the peer or router that it connects to.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Endpoints {
    /// Endpoints to listen at. Port 0 takes a free port; [`reachable_at`](crate::reachable_at) returns
    /// it.
    pub listen: Vec<String>,
    /// Endpoints to connect to. A client keeps one connection, so a program that must reach several
    /// learners or routers opens a session for each.
    pub connect: Vec<String>,
    /// With certificates, every connection uses TLS, and both sides show a certificate. A client of
    /// a session that listens may do what deploy/zenoh/router-tls.json5 allows its role.
    pub certificates: Option<Certificates>,
}

/// Endpoints at which no session can be opened.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each variant is.
pub enum SessionError {
    #[error("no endpoint to listen at or to connect to")]
    NoEndpoint,
    /// Zenoh would try forever to connect by an unknown protocol.
    #[error(
        "{0:?} is not an endpoint; write it like {OPEN}127.0.0.1:7447 or {PROTECTED}127.0.0.1:7447"
    )]
    NotAnEndpoint(String),
    #[error("certificates are given, but the connection at {0} would not be encrypted")]
    Open(String),
    #[error("{0} needs certificates")]
    NoCertificates(String),
    #[error("cannot use the Zenoh endpoint {endpoints}: {reason}")]
    Endpoint { endpoints: String, reason: String },
    #[error("the Zenoh session does not tell where it listens")]
    Unknown,
}

impl SessionError {
    /// Tells the user how to fix it.
    pub fn hint(&self) -> &'static str {
        match self {
            SessionError::Open(_) => {
                "write the endpoint like tls/HOST:PORT, or leave --certificates away"
            }
            SessionError::NoCertificates(_) => {
                "name their folder by --certificates DIR or QUAD_CERTIFICATES; deploy/zenoh/certificates.sh makes one"
            }
            SessionError::NotAnEndpoint(_) => {
                "an endpoint is a protocol, tcp or with certificates tls, a host and a port"
            }
            SessionError::Endpoint { reason, .. } if !reason.contains("in use") => {
                "--listen takes an address of this machine, or 0.0.0.0 for all of its addresses; --connect the router's"
            }
            _ => {
                "if the port is taken, perhaps by another learner, choose a free one with --listen tcp/127.0.0.1:0, \
                 or join a router with --connect"
            }
        }
    }
}

impl Endpoints {
    /// Checks early for what [`open_session`](crate::open_session) would refuse: no endpoint, or a
    /// malformed one; tcp/ with certificates, tls/ without.
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

    /// An endpoint at which other machines may connect without a certificate.
    pub fn open_to_all(&self) -> Option<&str> {
        self.for_others().filter(|_| self.certificates.is_none())
    }

    /// An endpoint for other machines that all of them would refuse, because the certificate contains
    /// only this machine's names for itself.
    pub(crate) fn closed_to_all(&self) -> Option<&str> {
        let certificates = self.certificates.as_ref();
        let is_local = certificates.is_some_and(Certificates::is_for_this_machine_alone);
        self.for_others().filter(|_| is_local)
    }

    /// True if the system chooses a port.
    pub(crate) fn has_open_port(&self) -> bool {
        self.listen.iter().any(|endpoint| address_of(endpoint).ends_with(":0"))
    }

    /// The first endpoint to listen at that is not on loopback.
    fn for_others(&self) -> Option<&str> {
        let is_local = |endpoint: &&String| {
            let address = address_of(endpoint);
            let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
            is_this_machine(host.trim_matches(['[', ']']))
        };
        self.listen.iter().find(|endpoint| !is_local(endpoint)).map(String::as_str)
    }
}

/// The default port of a learner.
pub const DEFAULT_PORT: u16 = 7447;

/// The default endpoint at which learner and evaluator of one machine meet.
pub fn default_endpoint(certificates: Option<&Certificates>, port: u16) -> String {
    let protocol = certificates.map_or(OPEN, |_| PROTECTED);
    format!("{protocol}127.0.0.1:{port}")
}

/// Checks an endpoint from the command line and returns it unchanged: a `value_parser`.
pub fn parse_endpoint(text: &str) -> Result<String, SessionError> {
    let is_known = text.starts_with(OPEN) || text.starts_with(PROTECTED);
    // Zenoh takes any text for an address, and would try it forever.
    let is_address = |(host, port): (&str, &str)| {
        !host.is_empty() && !host.contains(['/', ',']) && port.parse::<u16>().is_ok()
    };
    let has_address = address_of(text).rsplit_once(':').is_some_and(is_address);
    match is_known && has_address && text.parse::<EndPoint>().is_ok() {
        true => Ok(text.to_owned()),
        false => Err(SessionError::NotAnEndpoint(text.to_owned())),
    }
}

/// HOST:PORT of an endpoint, between its protocol and its options: `tcp/127.0.0.1:0#iface=lo`.
pub(crate) fn address_of(endpoint: &str) -> &str {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, rest)| rest);
    address.split(['?', '#']).next().unwrap_or(address)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_for_others_and_open_ports() {
        for (endpoint, is_local, has_open_port) in [
            ("tcp/127.0.0.1:7447", true, false),
            ("tcp/[::1]:7447", true, false),
            ("tcp/localhost:0", true, true),
            ("tcp/127.1.2.3:1#iface=lo", true, false),
            ("tcp/0.0.0.0:7447", false, false),
            ("tcp/[::]:7447", false, false),
            ("tcp/192.0.2.1:0", false, true),
            ("tcp/learner:10?prio=1-7", false, false),
            ("tcp/127.0.0.1:0?prio=1-7", true, true),
            ("tcp/0.0.0.0:0#iface=lo", false, true),
            ("tcp/[::0]:7447", false, false),
            ("tcp/127.0.0.1:7447#iface=e:0", true, false),
        ] {
            let listen = ["tcp/127.0.0.1:1", endpoint].map(str::to_owned).to_vec();
            let endpoints = Endpoints { listen, ..Endpoints::default() };
            assert_eq!(endpoints.open_to_all(), (!is_local).then_some(endpoint));
            assert_eq!(endpoints.has_open_port(), has_open_port, "{endpoint}");
            assert!(endpoints.check().is_ok(), "{endpoint}");
        }
    }

    #[test]
    fn a_taken_port_and_an_address_of_another_machine_have_different_hints() {
        let hint = |reason: &str| {
            let [endpoints, reason] = ["tcp/192.0.2.1:7447", reason].map(str::to_owned);
            SessionError::Endpoint { endpoints, reason }.hint()
        };
        assert!(hint("Address already in use (os error 98)").contains("port is taken"));
        assert!(hint("Cannot assign requested address (os error 99)").contains("0.0.0.0"));
    }

    #[test]
    fn an_endpoint_has_one_host_and_a_port() {
        for text in
            ["tcp/127.0.0.1", "tcp/", "tcp/:7447", "tcp/learner:", "tcp/learner:99999", "tcp/[::1]"]
        {
            assert!(parse_endpoint(text).is_err(), "{text}");
        }
        assert!(parse_endpoint("tcp/a:7447,tcp/b:7447").is_err());
        assert!(parse_endpoint("tcp/a:7447,b:7447").is_err());
        assert!(parse_endpoint("udp/127.0.0.1:7447").is_err());
    }
}
