//! Whether the certificates of a folder are good, for whom, and until when.
//!
//! The folder has `ca.pem`, which others' certificates must be signed by, and one's own `cert.pem` with its `key.pem`.

use std::path::Path;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use rustls::server::WebPkiClientVerifier;
use rustls::sign::CertifiedKey;
use rustls::{InconsistentKeys, RootCertStore};
use x509_parser::prelude::{FromDer, X509Certificate};

use super::Findings;
use crate::certificates::{AUTHORITY, CERTIFICATE, EXPIRES_SOON, KEY};
use crate::{Certificates, CertificatesError, Role};

const DAY: i64 = 24 * 3600;

const MAKE: &str = "make new ones, or copy all three files from where they were made";

/// Checks the certificates in `folder`, which are to be those of `role`, with the time that it is now. Gives them if a
/// connection can be tried with them.
pub fn folder(findings: &mut Findings, folder: &Path, role: Role) -> Option<Certificates> {
    by_themselves(findings, folder);
    match Certificates::read(folder, role) {
        Ok(certificates) => Some(certificates),
        Err(error) => {
            // Whatever else is wrong was found above.
            if matches!(error, CertificatesError::OtherRole { .. }) {
                findings.fail("role", error.to_string(), error.hint());
            }
            None
        }
    }
}

fn by_themselves(findings: &mut Findings, folder: &Path) {
    let [ca, own, key] = [AUTHORITY, CERTIFICATE, KEY].map(|name| folder.join(name));
    let ca = read(findings, &ca, CertificateDer::from_pem_file(&ca));
    let own_chain = CertificateDer::pem_file_iter(&own).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let own_chain = own_chain.and_then(|chain| match chain.is_empty() {
        true => Err(rustls::pki_types::pem::Error::NoItemsFound),
        false => Ok(chain),
    });
    let own = read(findings, &own, own_chain);
    let key = read(findings, &key, PrivateKeyDer::from_pem_file(&key));
    let now = SystemTime::now();
    if let Some(ca) = &ca {
        validity(findings, "authority", ca, now);
    }
    let Some(own) = own else { return };
    validity(findings, "certificate", &own[0], now);
    if let Some(key) = key {
        belongs_to(findings, &own, key);
    }
    if let Some(ca) = ca {
        signed_by(findings, &own, ca, now);
    }
}

fn read<T>(findings: &mut Findings, path: &Path, result: Result<T, rustls::pki_types::pem::Error>) -> Option<T> {
    result
        .inspect_err(|error| {
            let reason = match error {
                rustls::pki_types::pem::Error::Io(error) => error.to_string(),
                rustls::pki_types::pem::Error::NoItemsFound => "nothing of that kind in PEM is in it".to_owned(),
                other => other.to_string(),
            };
            findings.fail("certificates", format!("{}: {reason}", path.display()), MAKE);
        })
        .ok()
}

/// Whose it is, and from when until when it is good.
fn validity(findings: &mut Findings, check: &str, certificate: &CertificateDer<'_>, now: SystemTime) {
    let parsed = match X509Certificate::from_der(certificate) {
        Ok((_, parsed)) => parsed,
        Err(error) => return findings.fail(check, format!("it cannot be read: {error}"), MAKE),
    };
    let (from, until) = (parsed.validity().not_before, parsed.validity().not_after);
    let seconds = now.duration_since(UNIX_EPOCH).map_or(0, |time| time.as_secs() as i64);
    let left = until.timestamp().saturating_sub(seconds);
    let subject = parsed.subject();
    if from.timestamp() > seconds {
        let what = format!("{subject}: good from {from} only");
        findings.fail(check, what, "is this machine's clock right? `date -u` shows it");
    } else if left < 0 {
        findings.fail(check, format!("{subject}: expired on {until}"), MAKE);
    } else if left < EXPIRES_SOON {
        let what = format!("{subject}: good until {until}, which is {} days", left / DAY);
        findings.warn(check, what, "make a new one before then: without it nobody can connect");
    } else {
        findings.ok(check, format!("{subject}: good until {until}"));
    }
}

fn belongs_to(findings: &mut Findings, own: &[CertificateDer<'static>], key: PrivateKeyDer<'static>) {
    match CertifiedKey::from_der(own.to_vec(), key, &ring::default_provider()) {
        Ok(_) => findings.ok("private key", "it belongs to the certificate"),
        Err(rustls::Error::InconsistentKeys(InconsistentKeys::KeyMismatch)) => {
            findings.fail("private key", "key.pem is not the key of cert.pem", MAKE);
        }
        Err(error) => findings.fail("private key", format!("key.pem cannot be used: {error}"), MAKE),
    }
}

/// As the other side of a connection checks it.
fn signed_by(findings: &mut Findings, own: &[CertificateDer<'_>], ca: CertificateDer<'static>, now: SystemTime) {
    let mut roots = RootCertStore::empty();
    if let Err(error) = roots.add(ca) {
        return findings.fail("signature", format!("ca.pem is no certificate authority: {error}"), MAKE);
    }
    let provider = Arc::new(ring::default_provider());
    let verifier = match WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider).build() {
        Ok(verifier) => verifier,
        Err(error) => return findings.fail("signature", format!("ca.pem cannot be used: {error}"), MAKE),
    };
    let now = UnixTime::since_unix_epoch(now.duration_since(UNIX_EPOCH).unwrap_or_default());
    match verifier.verify_client_cert(&own[0], &own[1..], now) {
        Ok(_) => findings.ok("signature", "cert.pem is signed by ca.pem"),
        // Said above, with the dates.
        Err(rustls::Error::InvalidCertificate(
            rustls::CertificateError::Expired
            | rustls::CertificateError::ExpiredContext { .. }
            | rustls::CertificateError::NotValidYet
            | rustls::CertificateError::NotValidYetContext { .. },
        )) => {}
        Err(error) => findings.fail(
            "signature",
            format!("cert.pem does not pass with ca.pem: {error}"),
            "all who are to meet need certificates of the same authority; copy its ca.pem, or have a new cert.pem made there",
        ),
    }
}
