//! What becomes of a connection when the client's certificate expires, with certificates of deploy/zenoh/certificates.sh.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use quad_runtime::{Certificates, Endpoints, Role, open_session, reachable_at};
use tempfile::{TempDir, tempdir};
use tokio::time::timeout;
use zenoh::sample::SampleKind;
use zenoh::{Config, Session};

/// For what must happen; on a machine busy with other things.
const PATIENCE: Duration = Duration::from_secs(30);

/// `learner`, `steady` (an evaluator's) and `brief`, which is valid for eight seconds. `None` without openssl.
fn make_certificates() -> Option<TempDir> {
    let Ok(_) = Command::new("openssl").arg("version").output() else {
        eprintln!("left out: there is no openssl");
        return None;
    };
    let folder = tempdir().unwrap();
    let script = r#"
        for made in "learner learner" "evaluator steady" "evaluator brief"; do "$0" --in . $made; done
        # The script's days are too long.
        touch index; openssl rand -hex 8 >serial
        printf '[ca]\ndefault_ca=it\n[it]\ndatabase=index\nserial=serial\nnew_certs_dir=.\npolicy=any\n[any]\ncommonName=supplied\n' >config
        printf 'extendedKeyUsage=clientAuth\n' >extensions
        openssl req -new -key brief/key.pem -subj /CN=quad-evaluator -out request
        openssl ca -batch -notext -config config -md sha256 -in request -cert ca/ca.pem -keyfile ca/key.pem \
          -extfile extensions -enddate "$(date -u -d '+8 seconds' +%Y%m%d%H%M%SZ)" -out brief/cert.pem
    "#;
    let maker = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/zenoh/certificates.sh");
    let output = Command::new("bash").args(["-euc", script, maker]).current_dir(folder.path()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(folder)
}

/// A client that would stay connected by itself, however old its certificate is.
async fn client(endpoint: &str, certificates: &Path) -> Session {
    let mut config = Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[{endpoint:?}]")),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("transport/link/tls/root_ca_certificate", format!("{:?}", certificates.join("ca.pem"))),
        ("transport/link/tls/connect_certificate", format!("{:?}", certificates.join("cert.pem"))),
        ("transport/link/tls/connect_private_key", format!("{:?}", certificates.join("key.pem"))),
        ("transport/link/tls/enable_mtls", "true".to_owned()),
        ("transport/link/tls/close_link_on_expiration", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    zenoh::open(config).await.expect("the certificate is valid yet")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_that_listens_disconnects_a_client_whose_certificate_expires() {
    let Some(folder) = make_certificates() else { return };
    let of = |name: &str| folder.path().join(name);
    let certificates = Some(Certificates::read(&of("learner"), Role::Learner).unwrap());
    let endpoints = Endpoints { listen: vec!["tls/127.0.0.1:0".to_owned()], certificates, ..Endpoints::default() };
    let learner = open_session(&endpoints).await.unwrap();
    let endpoint = reachable_at(&learner, &endpoints).await.unwrap().remove(0);
    let tokens = learner.liveliness().declare_subscriber("quad/run/live/evaluator/*").await.unwrap();
    let next = async || timeout(PATIENCE, tokens.recv_async()).await.expect("no evaluator comes or goes").unwrap();

    let mut held = Vec::new();
    for name in ["brief", "steady"] {
        let session = client(&endpoint, &of(name)).await;
        let token = session.liveliness().declare_token(format!("quad/run/live/evaluator/{name}")).await.unwrap();
        held.push((session, token));
        assert_eq!(next().await.kind(), SampleKind::Put);
    }
    let gone = next().await;
    assert_eq!((gone.kind(), gone.key_expr().as_str()), (SampleKind::Delete, "quad/run/live/evaluator/brief"));
    let more = timeout(Duration::from_secs(2), tokens.recv_async()).await;
    assert!(more.is_err(), "a client with a valid certificate went, too, or the other came back: {more:?}");
}
