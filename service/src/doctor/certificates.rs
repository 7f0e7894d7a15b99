//! Whether the certificates of a folder are good, for whom, and until when.
//!
//! The folder has `ca.pem`, which others' certificates must be signed by, and one's own `cert.pem` with its `key.pem`.

use std::path::Path;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use rustls::crypto::ring;
use rustls::pki_types::pem::{self, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use rustls::server::WebPkiClientVerifier;
use rustls::sign::CertifiedKey;
use rustls::{InconsistentKeys, RootCertStore};
use x509_parser::prelude::{FromDer, X509Certificate};

use super::Findings;
use crate::certificates::{AUTHORITY, CERTIFICATE, EXPIRES_SOON, KEY, hosts, is_this_machine};
use crate::{Certificates, CertificatesError, Role};

const DAY: i64 = 24 * 3600;

const MAKE: &str = "make new ones, or copy all three files from where they were made";

/// Checks the certificates in `folder`, which are to be those of `role`, with the time that it is now. Gives them if a
/// connection can be tried with them.
pub fn folder(findings: &mut Findings, folder: &Path, role: Role) -> Option<Certificates> {
    by_themselves(findings, folder, role);
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

fn by_themselves(findings: &mut Findings, folder: &Path, role: Role) {
    let [ca, own, key] = [AUTHORITY, CERTIFICATE, KEY].map(|name| folder.join(name));
    let [ca, own] = [ca, own].map(|path| read(findings, &path, all_of(&path)));
    let key = read(findings, &key, PrivateKeyDer::from_pem_file(&key));
    let now = SystemTime::now();
    authorities(findings, ca.as_deref().unwrap_or_default(), own.as_ref().map(|own| &own[0]), now);
    let Some(own) = own else { return };
    validity(findings, "certificate", &own[0], now, Some(role));
    if let Some(key) = key {
        belongs_to(findings, &own, key);
    }
    if let Some(ca) = ca {
        signed_by(findings, &own, ca, now);
    }
}

/// Those that may have signed one's own certificate. Another one is trusted besides, and may be over.
fn authorities(findings: &mut Findings, all: &[CertificateDer<'_>], own: Option<&CertificateDer<'_>>, now: SystemTime) {
    let parse = |der| X509Certificate::from_der(der).ok().map(|(_, parsed)| parsed);
    let own = own.and_then(|own| parse(own));
    for ca in all {
        match (parse(ca), &own) {
            (Some(ca), Some(own)) if all.len() > 1 && ca.subject() != own.issuer() => {
                let (other, until) = (ca.subject(), ca.validity().not_after);
                findings.ok("authority", format!("{other}: trusted besides, until {until}"));
            }
            _ => validity(findings, "authority", ca, now, None),
        }
    }
}

/// All certificates of a file: while an authority is replaced, ca.pem has the old and the new one.
fn all_of(path: &Path) -> Result<Vec<CertificateDer<'static>>, pem::Error> {
    let all: Vec<_> = CertificateDer::pem_file_iter(path)?.collect::<Result<_, _>>()?;
    if all.is_empty() { Err(pem::Error::NoItemsFound) } else { Ok(all) }
}

fn read<T>(findings: &mut Findings, path: &Path, result: Result<T, pem::Error>) -> Option<T> {
    result
        .inspect_err(|error| {
            let reason = match error {
                pem::Error::Io(error) => error.to_string(),
                pem::Error::NoItemsFound => "nothing of that kind in PEM is in it".to_owned(),
                other => other.to_string(),
            };
            findings.fail("certificates", format!("{}: {reason}", path.display()), MAKE);
        })
        .ok()
}

/// Whose it is, from when until when it is good and, for the certificate of a program that may listen, at which hosts.
fn validity(
    findings: &mut Findings,
    check: &str,
    certificate: &CertificateDer<'_>,
    now: SystemTime,
    role: Option<Role>,
) {
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
        let whom = match role {
            Some(Role::Learner) => at_hosts(&hosts(&parsed)),
            _ => String::new(),
        };
        findings.ok(check, format!("{subject}: good until {until}{whom}"));
    }
}

/// Who may connect to a learner that listens.
fn at_hosts(hosts: &[String]) -> String {
    let alone = if hosts.iter().all(|host| is_this_machine(host)) { "no other machine" } else { "others" };
    match hosts {
        [] => "; nobody could connect to whoever listens with it, since it names no host".to_owned(),
        hosts => format!("; {alone} could connect to whoever listens with it: it names {}", hosts.join(", ")),
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
fn signed_by(findings: &mut Findings, own: &[CertificateDer<'_>], ca: Vec<CertificateDer<'static>>, now: SystemTime) {
    let mut roots = RootCertStore::empty();
    for ca in ca {
        if let Err(error) = roots.add(ca) {
            return findings.fail("signature", format!("ca.pem is no certificate authority: {error}"), MAKE);
        }
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
