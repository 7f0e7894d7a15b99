//! Certificates of every role, made with deploy/zenoh/certificates.sh, and sessions that show them.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread::sleep;
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
        let folder = tempdir().unwrap();
        let made: [&[&str]; 5] = [
            &["router", "router", "127.0.0.1"],
            &["learner", "learner"],
            &["evaluator", "evaluator"],
            &["monitor", "monitor"],
            &["--days", "0", "evaluator", "expired"],
        ];
        let are_made = made.iter().all(|arguments| peers::certificates(folder.path(), arguments));
        // The expired one is valid until the second in which it was made is over.
        sleep(Duration::from_secs(1));
        are_made.then_some(Certificates { folder })
    }

    /// Makes an evaluator's certificate anew.
    pub fn renew(&self, name: &str) {
        assert!(peers::certificates(self.folder.path(), &["evaluator", name]));
    }

    /// Makes an evaluator's certificate that is valid for `seconds`; the script takes days.
    pub fn short(&self, name: &str, seconds: u64) {
        self.renew(name);
        let script = r#"
            : >index; openssl rand -hex 8 >serial
            printf '[ca]\ndefault_ca=it\n[it]\ndatabase=index\nserial=serial\nnew_certs_dir=.\npolicy=any\n[any]\n' >config
            printf 'organizationName=optional\norganizationalUnitName=optional\ncommonName=supplied\n' >>config
            printf 'extendedKeyUsage=clientAuth\n' >extensions
            openssl req -new -key "$2/key.pem" -subj /CN=quad-evaluator -out request
            openssl ca -batch -notext -config config -md sha256 -in request -cert ca/ca.pem -keyfile ca/key.pem \
              -extfile extensions -enddate "$(date -u -d "+$1 seconds" +%Y%m%d%H%M%SZ)" -out "$2/cert.pem"
        "#;
        let arguments = ["-euc", script, "sh", &seconds.to_string(), name];
        let mut sh = Command::new("sh");
        stdout(&sh.args(arguments).current_dir(self.folder.path()).output().unwrap());
    }

    /// The folder of all of them.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    pub fn of(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Path of a certificate, for a command line.
    pub fn argument(&self, name: &str) -> String {
        self.of(name).to_str().unwrap().to_owned()
    }
}

/// Connects with the certificate in `folder`, which is to be let in, and trusts the authority of
/// `trusted`.
pub async fn come_in(endpoint: &str, trusted: &Path, folder: &Path) -> Session {
    let deadline = Instant::now() + PATIENCE;
    loop {
        match connect(endpoint, trusted, Some(folder)).await {
            Ok(session) => return session,
            Err(error) => {
                assert!(Instant::now() < deadline, "{folder:?} does not come in: {error}")
            }
        }
    }
}

/// Connects with the certificate in `folder`, or with none, and trusts the authority of `trusted`.
/// Gives up soon.
pub async fn connect(
    endpoint: &str,
    trusted: &Path,
    folder: Option<&Path>,
) -> zenoh::Result<Session> {
    let shown = folder.map_or(String::new(), |folder| {
        let [certificate, key] = ["cert.pem", "key.pem"].map(|file| folder.join(file));
        format!(
            "enable_mtls: true, connect_certificate: {certificate:?}, connect_private_key: {key:?}"
        )
    });
    let authority = trusted.join("ca.pem");
    let config = format!(
        "{{ mode: 'client',
            connect: {{ endpoints: [{endpoint:?}], timeout_ms: 2000, exit_on_failure: true }},
            scouting: {{ multicast: {{ enabled: false }} }},
            transport: {{ link: {{ tls: {{ root_ca_certificate: {authority:?}, {shown} }} }} }} }}"
    );
    zenoh::open(Config::from_json5(&config)?).await
}
