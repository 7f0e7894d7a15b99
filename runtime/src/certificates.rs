//! Certificates of a program's role, made by `deploy/zenoh/certificates.sh`.

use std::env;
use std::fmt;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::CertificateError::{BadSignature, UnknownIssuer};
use rustls::crypto::ring;
use rustls::pki_types::pem::{Error as PemError, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use rustls::server::WebPkiClientVerifier;
use rustls::sign::CertifiedKey;
use rustls::{Error as TlsError, RootCertStore};
use serde_json::{Value, json};
use tracing::{info, warn};
use x509_parser::extensions::GeneralName;
use x509_parser::prelude::{FromDer, X509Certificate};
use x509_parser::time::ASN1Time;

/// The trusted authority, the program's own certificate, and its private key.
const FILES: [&str; 3] = ["ca.pem", "cert.pem", "key.pem"];

/// Days before its expiry from which a certificate causes a warning.
const EXPIRES_SOON: i64 = 14;

const HINT: &str = "--certificates takes a folder with ca.pem, cert.pem and key.pem that this user may read; \
                    deploy/zenoh/certificates.sh makes one";
const HINT_TIME: &str = "if the clock of this machine is right, make a new certificate with deploy/zenoh/certificates.sh";
const HINT_ROLE: &str = "give the folder that was made for this program's role";

/// The folder of certificates of the command line, else of the variable QUAD_CERTIFICATES.
pub fn certificates_folder(named: Option<PathBuf>) -> Option<PathBuf> {
    let variable = || env::var_os("QUAD_CERTIFICATES").filter(|folder| !folder.is_empty());
    named.or_else(|| variable().map(PathBuf::from))
}

/// Role of a certificate's owner, by the certificate's common name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Publishes weights, hands out jobs, records scores.
    Learner,
    /// Claims jobs, delivers scores.
    Evaluator,
}

impl Role {
    /// The common name of this role's certificates, as in deploy/zenoh/router-tls.json5.
    fn common_name(self) -> &'static str {
        match self {
            Role::Learner => "quad-learner",
            Role::Evaluator => "quad-evaluator",
        }
    }
}

/// A folder with an authority (ca.pem), a certificate that it has signed (cert.pem), and the
/// certificate's key (key.pem). Zenoh reads the files again for each connection that it opens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Certificates {
    folder: PathBuf,
    expires: ASN1Time,
    /// Names and addresses at which clients may connect to the owner.
    hosts: Vec<String>,
}

/// A certificate file that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{} {problem}", path.display())]
pub struct CertificatesError {
    path: PathBuf,
    problem: String,
    hint: &'static str,
}

impl CertificatesError {
    /// Tells the user how to fix it.
    pub fn hint(&self) -> &'static str {
        self.hint
    }

    fn new(path: &Path, problem: impl Into<String>, hint: &'static str) -> Self {
        let (path, problem) = (path.to_owned(), problem.into());
        Self { path, problem, hint }
    }
}

impl Certificates {
    /// Checks the files in `folder` as the other side of a connection would, and that the
    /// certificate is for `role`. Logs the certificate's expiry.
    pub fn read(folder: &Path, role: Role) -> Result<Self, CertificatesError> {
        let certificates = Self::check(folder, role)?;
        match certificates.expire_soon() {
            true => warn!("{certificates}; make a new one soon"),
            false => info!("{certificates}"),
        }
        Ok(certificates)
    }

    /// Checks as [`read`](Self::read), without the log.
    pub(crate) fn check(folder: &Path, role: Role) -> Result<Self, CertificatesError> {
        let [ca, own, key] = FILES.map(|name| folder.join(name));
        let (authorities, chain) = (certificates(&ca)?, certificates(&own)?);
        let private = PrivateKeyDer::from_pem_file(&key)
            .map_err(|error| unreadable(&key, "private key", &error))?;
        let refuse = |problem: String, hint| Err(CertificatesError::new(&own, problem, hint));
        let Ok((_, certificate)) = X509Certificate::from_der(&chain[0]) else {
            return refuse("holds no certificate that can be read".to_owned(), HINT);
        };
        let names = certificate.subject().iter_common_name().filter_map(|name| name.as_str().ok());
        let (names, wanted) = (Vec::from_iter(names).join(", "), role.common_name());
        if names != wanted {
            return refuse(format!("is a certificate for {names}, not for {wanted}"), HINT_ROLE);
        }
        let validity = certificate.validity();
        if !validity.is_valid() {
            let (from, until) = (validity.not_before, validity.not_after);
            return refuse(format!("is valid from {from} to {until}, which is not now"), HINT_TIME);
        }
        let (expires, hosts) = (validity.not_after, hosts(&certificate));
        match verify(&chain, authorities) {
            Ok(()) => {}
            // An authority of the same name may have another key.
            Err(TlsError::InvalidCertificate(UnknownIssuer | BadSignature)) => {
                return refuse(format!("is of another authority than {}", ca.display()), HINT);
            }
            Err(other) => {
                return refuse(format!("does not pass with {}: {other}", ca.display()), HINT);
            }
        }
        if CertifiedKey::from_der(chain, private, &ring::default_provider()).is_err() {
            let problem = format!("is not the key of {}", own.display());
            return Err(CertificatesError::new(&key, problem, HINT));
        }
        let folder = folder.to_owned();
        Ok(Self { folder, expires, hosts })
    }

    /// True if the operator should renew the certificate.
    pub(crate) fn expire_soon(&self) -> bool {
        self.expires.timestamp() - ASN1Time::now().timestamp() < EXPIRES_SOON * 24 * 60 * 60
    }

    /// True if only programs on this machine can connect to the owner.
    pub(crate) fn is_for_this_machine_alone(&self) -> bool {
        self.hosts.iter().all(|host| is_this_machine(host))
    }

    /// Zenoh's `transport/link/tls`: both sides show a certificate and disconnect at its expiry.
    pub(crate) fn settings(&self) -> Value {
        let [authority, certificate, key] = FILES.map(|name| self.folder.join(name));
        json!({
            "root_ca_certificate": authority,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
            "enable_mtls": true,
            "verify_name_on_connect": true,
            "close_link_on_expiration": true,
        })
    }
}

impl fmt::Display for Certificates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (path, hosts) = (self.folder.join(FILES[1]), self.hosts.join(", "));
        write!(f, "{} is valid until {}", path.display(), self.expires)?;
        // An evaluator's certificate names no host: an evaluator never listens.
        match hosts.is_empty() {
            true => Ok(()),
            false => write!(f, ", to listen at {hosts}"),
        }
    }
}

/// All certificates of a file. While an authority is replaced, ca.pem has the old and the new one.
fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, CertificatesError> {
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    match read {
        Ok(certificates) if !certificates.is_empty() => Ok(certificates),
        Ok(_) => Err(unreadable(path, "certificate", &PemError::NoItemsFound)),
        Err(error) => Err(unreadable(path, "certificate", &error)),
    }
}

fn unreadable(path: &Path, wanted: &str, error: &PemError) -> CertificatesError {
    let problem = match error {
        PemError::Io(error) => format!("cannot be read: {error}"),
        _ => format!("holds no {wanted} in PEM's notation"),
    };
    CertificatesError::new(path, problem, HINT)
}

/// Verifies that one of the authorities has signed the certificate, and that it is valid now.
fn verify(
    chain: &[CertificateDer<'_>],
    authorities: Vec<CertificateDer<'static>>,
) -> Result<(), TlsError> {
    let mut roots = RootCertStore::empty();
    for authority in authorities {
        roots.add(authority)?;
    }
    let provider = Arc::new(ring::default_provider());
    let verifier = WebPkiClientVerifier::builder_with_provider(roots.into(), provider).build();
    let verifier = verifier.map_err(|error| TlsError::General(error.to_string()))?;
    verifier.verify_client_cert(&chain[0], &chain[1..], UnixTime::now())?;
    Ok(())
}

/// The names and addresses in a certificate.
fn hosts(certificate: &X509Certificate<'_>) -> Vec<String> {
    let host = |name: &GeneralName<'_>| match *name {
        GeneralName::DNSName(name) => Some(name.to_owned()),
        GeneralName::IPAddress(bytes) => {
            let four = <[u8; 4]>::try_from(bytes).map(IpAddr::from);
            let address = four.or_else(|_| <[u8; 16]>::try_from(bytes).map(IpAddr::from));
            address.ok().map(|address| address.to_string())
        }
        _ => None,
    };
    let names = certificate.subject_alternative_name().ok().flatten();
    let names = names.iter().flat_map(|names| &names.value.general_names);
    names.filter_map(host).collect()
}

/// True if a host is only this machine's name for itself.
pub(crate) fn is_this_machine(host: &str) -> bool {
    host == "localhost" || host.parse().is_ok_and(|host: IpAddr| host.is_loopback())
}
