//! Who a program is to the others, by the three files that `deploy/zenoh/certificates.sh` makes.

use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::{fs, io};

use rustls::crypto::ring;
use rustls::pki_types::pem::{self, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::sign::CertifiedKey;
use serde_json::{Value, json};
use tracing::{info, warn};
use x509_parser::certificate::X509Certificate;
use x509_parser::extensions::GeneralName;
use x509_parser::pem::Pem;
use x509_parser::time::ASN1Time;

/// Names of the three files.
pub(crate) const AUTHORITY: &str = "ca.pem";
pub(crate) const CERTIFICATE: &str = "cert.pem";
pub(crate) const KEY: &str = "key.pem";

/// A certificate that is valid for less than this is worth a warning, seconds: renewing takes people time.
pub(crate) const EXPIRES_SOON: i64 = 14 * 24 * 60 * 60;

/// What a certificate entitles to. Access control tells roles apart by the certificate's common name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Publishes weights, answers jobs and scores.
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

/// A folder with the authority that is trusted (ca.pem), this program's certificate (cert.pem) and its key (key.pem).
///
/// Zenoh reads the files again for each connection that it makes, and once for each endpoint that it listens at.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Certificates {
    folder: PathBuf,
    /// The hosts at which its owner may be connected to.
    hosts: Vec<String>,
}

/// The files cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CertificatesError {
    /// A file is missing, or may not be read.
    #[error("cannot read {}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// A file holds something else.
    #[error("{} holds no {wanted} in PEM's notation", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What belongs there.
        wanted: &'static str,
    },
    /// The certificate is not valid any more, or not yet.
    #[error("{} is valid from {from} to {to}, which is not now", path.display())]
    NotValidNow {
        /// The certificate's file.
        path: PathBuf,
        /// First moment of its validity.
        from: String,
        /// Last moment of its validity.
        to: String,
    },
    /// It is a certificate for another program.
    #[error("{} is a certificate for {found}, not for {wanted}", path.display())]
    OtherRole {
        /// The certificate's file.
        path: PathBuf,
        /// Its common name.
        found: String,
        /// The one that is needed.
        wanted: &'static str,
    },
    /// Whoever trusts the same authority would refuse it.
    #[error("{} is of another authority than {}", path.display(), authority.display())]
    OtherAuthority {
        /// The certificate's file.
        path: PathBuf,
        /// The authority's file.
        authority: PathBuf,
    },
    /// Its owner could not prove that it is its.
    #[error("{} is not the key of {}", key.display(), path.display())]
    OtherKey {
        /// The certificate's file.
        path: PathBuf,
        /// The key's file.
        key: PathBuf,
    },
}

impl CertificatesError {
    /// What to do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            CertificatesError::NotValidNow { .. } => {
                "if the clock of this machine is right, make a new certificate with deploy/zenoh/certificates.sh"
            }
            CertificatesError::OtherRole { .. } => "give the folder that was made for this program's role",
            _ => {
                "--certificates takes a folder with ca.pem, cert.pem and key.pem that this user may read; \
                 deploy/zenoh/certificates.sh makes one"
            }
        }
    }
}

impl Certificates {
    /// Checks the files in `folder`, whose certificate must be one of `role`, and logs until when it is valid.
    ///
    /// # Errors
    ///
    /// Whatever would have all others refuse the certificate; that of another authority is only told by its name.
    pub fn read(folder: &Path, role: Role) -> Result<Self, CertificatesError> {
        let (authority, path) = (folder.join(AUTHORITY), folder.join(CERTIFICATE));
        let authorities = certificates(&authority)?;
        let own = certificates(&path)?;
        let key_path = folder.join(KEY);
        let key = key(&key_path)?;

        let certificate = parse(&own[0], &path)?;
        let found = certificate.subject().iter_common_name().next().and_then(|name| name.as_str().ok());
        if found != Some(role.common_name()) {
            let (found, wanted) = (found.unwrap_or("nobody").to_owned(), role.common_name());
            return Err(CertificatesError::OtherRole { path, found, wanted });
        }
        let validity = certificate.validity();
        if !validity.is_valid() {
            let (from, to) = (validity.not_before.to_string(), validity.not_after.to_string());
            return Err(CertificatesError::NotValidNow { path, from, to });
        }
        let mut known = false;
        for pem in &authorities {
            known |= parse(pem, &authority)?.subject() == certificate.issuer();
        }
        if !known {
            return Err(CertificatesError::OtherAuthority { path, authority });
        }
        let chain = own.iter().map(|pem| CertificateDer::from(pem.contents.clone())).collect();
        if CertifiedKey::from_der(chain, key, &ring::default_provider()).is_err() {
            return Err(CertificatesError::OtherKey { path, key: key_path });
        }

        let left = validity.not_after.timestamp() - ASN1Time::now().timestamp();
        match left < EXPIRES_SOON {
            true => warn!("{} is valid until {} only; make a new one soon", path.display(), validity.not_after),
            false => info!("{} is valid until {}", path.display(), validity.not_after),
        }
        Ok(Self { folder: folder.to_owned(), hosts: hosts(&certificate) })
    }

    /// Whether nobody but this machine itself could connect to whoever listens with it.
    pub(crate) fn is_for_this_machine_alone(&self) -> bool {
        self.hosts.iter().all(|host| is_this_machine(host))
    }

    /// Zenoh's `transport/link/tls`: both sides show a certificate, and stay connected only while it is valid.
    pub(crate) fn settings(&self) -> Value {
        let [authority, certificate, key] = [AUTHORITY, CERTIFICATE, KEY].map(|name| self.folder.join(name));
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

fn certificates(path: &Path) -> Result<Vec<Pem>, CertificatesError> {
    let found = blocks(path, "CERTIFICATE")?;
    if found.is_empty() { Err(malformed(path, "certificate")) } else { Ok(found) }
}

fn key(path: &Path) -> Result<PrivateKeyDer<'static>, CertificatesError> {
    PrivateKeyDer::from_pem_file(path).map_err(|error| match error {
        pem::Error::Io(source) => CertificatesError::Unreadable { path: path.to_owned(), source },
        _ => malformed(path, "private key"),
    })
}

/// The names and addresses in a certificate at which its owner may be connected to.
pub(crate) fn hosts(certificate: &X509Certificate<'_>) -> Vec<String> {
    let names = certificate.subject_alternative_name().ok().flatten().map(|names| &names.value.general_names);
    let host = |name: &GeneralName<'_>| match *name {
        GeneralName::DNSName(name) => Some(name.to_owned()),
        GeneralName::IPAddress(bytes) => {
            let four = <[u8; 4]>::try_from(bytes).map(IpAddr::from);
            four.or_else(|_| <[u8; 16]>::try_from(bytes).map(IpAddr::from)).ok().map(|address| address.to_string())
        }
        _ => None,
    };
    names.into_iter().flatten().filter_map(host).collect()
}

/// Whether a host is only this machine's name for itself.
pub(crate) fn is_this_machine(host: &str) -> bool {
    host == "localhost" || host.parse().is_ok_and(|host: IpAddr| host.is_loopback())
}

fn blocks(path: &Path, label: &str) -> Result<Vec<Pem>, CertificatesError> {
    let bytes = fs::read(path).map_err(|source| CertificatesError::Unreadable { path: path.to_owned(), source })?;
    Ok(Pem::iter_from_buffer(&bytes).filter_map(Result::ok).filter(|pem| pem.label == label).collect())
}

fn parse<'a>(pem: &'a Pem, path: &Path) -> Result<X509Certificate<'a>, CertificatesError> {
    pem.parse_x509().map_err(|_| malformed(path, "certificate"))
}

fn malformed(path: &Path, wanted: &'static str) -> CertificatesError {
    CertificatesError::Malformed { path: path.to_owned(), wanted }
}
