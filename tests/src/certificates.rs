//! Certificates of every role, made with deploy/zenoh/certificates.sh, and sessions that show them.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use tempfile::{TempDir, tempdir};
use zenoh::{Config, Session};

use crate::process::stdout;
use crate::{PATIENCE, peers};

/// A folder of certificates, one of each role, besides an expired one.
pub struct Certificates {
    folder: TempDir,
}

impl Certificates {
    /// Makes certificates of a new authority. `None` if the test is to be skipped.
    pub fn make() -> Option<Certificates> {
        if !peers::has("openssl", "version") {
            return None;
        }
        let certificates = Certificates { folder: tempdir().unwrap() };
        certificates.run_script(&["router", "router", "127.0.0.1"]);
        for role in ["learner", "evaluator", "monitor"] {
            certificates.run_script(&[role, role]);
        }
        certificates.run_script(&["--days", "0", "evaluator", "expired"]);
        // It is valid until the second in which it was made is over.
        std::thread::sleep(Duration::from_secs(1));
        Some(certificates)
    }

    /// Runs the script that users have.
    pub fn run_script(&self, arguments: &[&str]) {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/zenoh/certificates.sh");
        let mut script = Command::new(script);
        stdout(&script.arg("--in").arg(self.folder()).args(arguments).output().unwrap());
    }

    /// Makes an evaluator's certificate that is valid for `seconds`; the script takes days.
    pub fn make_brief(&self, name: &str, seconds: u64) {
        self.run_script(&["evaluator", name]);
        let script = r#"
            : >index; openssl rand -hex 8 >serial
            printf '[ca]\ndefault_ca=it\n[it]\ndatabase=index\nserial=serial\nnew_certs_dir=.\npolicy=any\n[any]\n' >config
            printf 'organizationName=optional\norganizationalUnitName=optional\ncommonName=supplied\n' >>config
            printf 'extendedKeyUsage=clientAuth\n' >extensions
            openssl req -new -key "$2/key.pem" -subj /CN=quad-evaluator -out request
            openssl ca -batch -notext -config config -md sha256 -in request -cert ca/ca.pem -keyfile ca/key.pem \
              -extfile extensions -enddate "$(date -u -d "+$1 seconds" +%Y%m%d%H%M%SZ)" -out "$2/cert.pem"
        "#;
        let mut sh = Command::new("sh");
        sh.args(["-euc", script, "sh", &seconds.to_string(), name]);
        stdout(&sh.current_dir(self.folder()).output().unwrap());
    }

    /// The folder of all of them.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// The folder of one.
    pub fn path(&self, name: &str) -> String {
        self.folder().join(name).to_str().unwrap().to_owned()
    }
}

/// Connects with the certificate in `folder`, which is to be let in, and trusts the authority of
/// `trusted`.
pub async fn connect(endpoint: &str, trusted: &str, folder: &str) -> Session {
    let deadline = Instant::now() + PATIENCE;
    loop {
        match try_to_connect(endpoint, trusted, Some(folder)).await {
            Ok(session) => return session,
            Err(error) => {
                assert!(Instant::now() < deadline, "{folder} does not come in: {error}");
            }
        }
    }
}

/// Connects with the certificate in `folder`, or with none, and trusts the authority of `trusted`.
/// Gives up soon.
pub async fn try_to_connect(
    endpoint: &str,
    trusted: &str,
    folder: Option<&str>,
) -> zenoh::Result<Session> {
    let shown = folder.map_or(String::new(), |folder| {
        let [certificate, key] = ["cert.pem", "key.pem"].map(|file| format!("{folder}/{file}"));
        format!(
            "enable_mtls: true, connect_certificate: {certificate:?}, connect_private_key: {key:?}"
        )
    });
    let authority = format!("{trusted}/ca.pem");
    let config = format!(
        "{{ mode: 'client',
            connect: {{ endpoints: [{endpoint:?}], timeout_ms: 2000, exit_on_failure: true }},
            scouting: {{ multicast: {{ enabled: false }} }},
            transport: {{ link: {{ tls: {{ root_ca_certificate: {authority:?}, {shown} }} }} }} }}"
    );
    zenoh::open(Config::from_json5(&config)?).await
}
