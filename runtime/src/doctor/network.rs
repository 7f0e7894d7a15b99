//! Checks of certificates and of the endpoints at which learner and evaluators meet.

use std::io::{self, ErrorKind};
use std::net::{Ipv4Addr, TcpListener};
use std::path::Path;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::runtime::Builder;
use tokio::time::timeout;
use zenoh::Session;

use super::Findings;
use crate::certificates::{Certificates, Role};
use crate::endpoints::{Endpoints, address_of};
use crate::session::open_session;

/// Time limit of a TCP connection: one across the world takes half a second.
const CONNECT: Duration = Duration::from_secs(3);
/// Time limit of a connection with Zenoh's own handshake, and perhaps TLS's.
const SESSION: Duration = Duration::from_secs(5);

/// Checks the certificates in `folder`, which must be for `role`.
pub fn certificates(findings: &mut Findings, folder: &Path, role: Role) -> Option<Certificates> {
    let checked = Certificates::check(folder, role);
    match &checked {
        Err(error) => findings.fail("certificate", error.to_string(), error.hint()),
        Ok(certificates) if certificates.expire_soon() => {
            let hint = "make a new one before then with deploy/zenoh/certificates.sh";
            findings.warn("certificate", certificates.to_string(), hint);
        }
        Ok(certificates) => findings.ok("certificate", certificates.to_string()),
    }
    checked.ok()
}

/// Checks that a learner can listen at a port of this machine.
pub fn port(findings: &mut Findings, port: u16) {
    let endpoint = format!("tcp/127.0.0.1:{port}");
    match TcpListener::bind((Ipv4Addr::LOCALHOST, port)) {
        Ok(_) => findings.ok("port", format!("{endpoint} is free for the learner to listen at")),
        Err(error) => {
            let hint = "if another learner has it, choose a free one by --listen tcp/127.0.0.1:0, or a router by --connect";
            findings.warn("port", format!("{endpoint} cannot be listened at: {error}"), hint);
        }
    }
}

/// Connects to the first endpoint, by TCP alone and then with Zenoh, and does further checks over the
/// session.
pub fn connected<E: From<io::Error>>(
    findings: &mut Findings,
    endpoints: &Endpoints,
    further: impl AsyncFnOnce(&mut Findings, &Session) -> Result<(), E>,
) -> Result<(), E> {
    let runtime = Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let done = runtime.block_on(async {
        let Some(session) = connect(findings, endpoints).await else { return Ok(()) };
        let done = further(findings, &session).await;
        session.close().await.ok();
        done
    });
    runtime.shutdown_background();
    done
}

async fn connect(findings: &mut Findings, endpoints: &Endpoints) -> Option<Session> {
    if let Err(error) = endpoints.check() {
        findings.fail("connection", error.to_string(), error.hint());
        return None;
    }
    let endpoint = endpoints.connect.first()?;
    let address = address_of(endpoint);
    let reached = timeout(CONNECT, TcpStream::connect(address)).await;
    if let Err(error) = reached.unwrap_or_else(|_| Err(ErrorKind::TimedOut.into())) {
        let hint = match error.kind() {
            ErrorKind::ConnectionRefused => {
                "that machine is there, but nothing listens at this port: is the learner or router started, and does \
                 it listen for other machines, as at tcp/0.0.0.0:7447, or only at 127.0.0.1?"
            }
            ErrorKind::TimedOut => {
                "does a firewall drop what goes to this port, or is the address of another network?"
            }
            _ => "is the name spelled right, and is there a network?",
        };
        findings.fail("connection", format!("{address}: {error}"), hint);
        return None;
    }
    let reason = match timeout(SESSION, open_session(endpoints)).await {
        Ok(Ok(session)) => {
            findings.ok("connection", format!("{endpoint} is there, and speaks Zenoh"));
            return Some(session);
        }
        Ok(Err(error)) => format!("{endpoint}: {error}"),
        Err(_) => format!(
            "something listens at {address}, but there is no Zenoh session with it after {SESSION:?}"
        ),
    };
    let hint = "is it a learner or a Zenoh router, of the same protocol (tcp or tls), with certificates of the same authority?";
    findings.fail("connection", reason, hint);
    None
}
