//! Programs that may connect: those with a certificate, at the router as it is shipped and at a
//! learner that listens itself.

use std::path::PathBuf;
use std::time::Instant;

use quad_protocol::keys;
use quad_tests::PATIENCE;
use quad_tests::certificates::{Certificates, come_in, connect};
use quad_tests::made_up::name;
use quad_tests::router::protected_router;
use quad_tests::setting::{ENDLESS, IDLE, SHORT, Setting};
use quad_tests::system::Scratch;
use tokio::time::timeout;
use zenoh::sample::SampleKind;

/// Host of the router's certificate.
pub const HOST: &str = "127.0.0.1";
/// For so many seconds a certificate is valid that a program is to come in with, and to be sent
/// away with.
const BRIEF: u64 = 40;

#[tokio::test(flavor = "multi_thread")]
async fn an_online_run_completes_through_the_shipped_router() {
    let Some(certificates) = Certificates::make() else { return };
    let (_router, endpoint) = protected_router(HOST, &certificates.of("router")).await;
    let scratch = Scratch::new();
    let [ours, theirs] = ["learner", "evaluator"].map(|role| certificates.argument(role));
    let connect = ["--connect", &endpoint, "--certificates"];
    let _evaluator = scratch.evaluator_with("trusted", &[&connect[..], &[&theirs]].concat());
    let setting = Setting { eval_interval: 250, online_steps: 300, ..SHORT };
    let mut learner = scratch.learner_with("run", setting, &[&connect[..], &[&ours]].concat());
    learner.assert_completes(PATIENCE);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_router_with_a_certificate_for_another_host_is_refused() {
    let Some(certificates) = Certificates::make() else { return };
    let (_router, endpoint) = protected_router("127.0.0.2", &certificates.of("router")).await;
    let (scratch, folder) = (Scratch::new(), certificates.argument("evaluator"));
    let launcher = ["env", "RUST_LOG=info,zenoh=debug"].map(str::to_owned);
    let arguments = ["--connect", &endpoint, "--certificates", &folder];
    let evaluator = scratch.evaluator_through(&launcher, "careful", &arguments);
    evaluator.process.wait_for_log("certificate not valid for name", PATIENCE);
    evaluator.process.assert_not_said("Successfully connected");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_listening_learner_checks_certificates() {
    let Some(certificates) = Certificates::make() else { return };
    let (scratch, folder) = (Scratch::new(), certificates.argument("learner"));
    let listen = ["--listen", "tls/127.0.0.1:0", "--certificates", &folder];
    let learner = scratch.learner_with("run", ENDLESS, &listen);
    let (endpoint, authority) = (learner.endpoint(), certificates.of("learner"));
    assert!(endpoint.starts_with("tls/127.0.0.1:"), "{endpoint}");

    for (name, reason) in
        [(None, "peer sent no certificates"), (Some("expired"), "certificate expired")]
    {
        let folder = name.map(|name| certificates.of(name));
        let deadline = Instant::now() + PATIENCE;
        // A busy machine may take longer than an attempt does.
        while !learner.process.log().contains(reason) {
            let session = connect(&endpoint, &authority, folder.as_deref()).await;
            assert!(session.is_err(), "{name:?} came in");
            assert!(Instant::now() < deadline, "{reason:?} is not said");
        }
    }

    let folder = certificates.argument("evaluator");
    let _evaluator =
        scratch.evaluator_with("trusted", &["--connect", &endpoint, "--certificates", &folder]);
    learner.wait_for_scores(0);

    // One that would stay connected by itself, although its certificate has expired. The other one
    // stays.
    certificates.short("brief", BRIEF);
    let brief = come_in(&endpoint, &authority, &certificates.of("brief")).await;
    let key = keys::live_evaluator(&name("run"), &name("brief"));
    let _token = brief.liveliness().declare_token(key).await.unwrap();
    for said in ["evaluator brief is here", "evaluator brief has left"] {
        learner.process.wait_for_log(said, PATIENCE);
    }
    learner.wait_for_metric("evaluators", "", |there| there == 1.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_router_refuses_invalid_certificates() {
    let Some(certificates) = Certificates::make() else { return };
    let elsewhere = Certificates::make().unwrap();
    let (_router, endpoint) = protected_router(HOST, &certificates.of("router")).await;
    let (authority, evaluator) = (certificates.of("router"), certificates.of("evaluator"));
    // In all but the certificate they are what is let in.
    come_in(&endpoint, &authority, &evaluator).await;
    let foreign = elsewhere.of("evaluator");
    let expired = certificates.of("expired");
    // The other way round: a router that is not of the evaluator's authority, or only an evaluator,
    // is not talked to.
    let (_impostor, impostor) = protected_router(HOST, &evaluator).await;
    for (endpoint, authority, folder) in [
        (&endpoint, &authority, None),
        (&endpoint, &authority, Some(&foreign)),
        (&endpoint, &authority, Some(&expired)),
        (&endpoint, &foreign, Some(&foreign)),
        (&impostor, &authority, Some(&evaluator)),
    ] {
        let session = connect(endpoint, authority, folder.map(PathBuf::as_path)).await;
        assert!(session.is_err(), "{folder:?} came in at {endpoint}");
    }

    // And it says so, instead of waiting in silence.
    let (scratch, folder) = (Scratch::new(), elsewhere.argument("evaluator"));
    let connect = ["--connect", &impostor, "--certificates", &folder];
    let stray = scratch.evaluator_with("stray", &connect);
    stray.process.wait_for_log("refuses the other's certificate", PATIENCE);
    stray.process.assert_not_said("connected");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_expired_certificate_ends_a_connection_and_a_renewed_one_brings_it_back() {
    let Some(certificates) = Certificates::make() else { return };
    let (scratch, folder) = (Scratch::new(), certificates.argument("learner"));
    let (_router, endpoint) = protected_router(HOST, &certificates.of("router")).await;
    let connect = ["--connect", &endpoint, "--certificates"];
    let _learner = scratch.learner_with("run", IDLE, &[&connect[..], &[&folder]].concat());
    let monitor = come_in(&endpoint, &certificates.of("router"), &certificates.of("monitor")).await;
    let evaluators = "quad/run/live/evaluator/*";
    let tokens = monitor.liveliness().declare_subscriber(evaluators).history(true).await.unwrap();
    let next = async || timeout(PATIENCE, tokens.recv_async()).await.unwrap().unwrap().kind();
    certificates.short("brief", BRIEF);
    let folder = certificates.argument("brief");
    let evaluator = scratch.evaluator_with("brief", &[&connect[..], &[&folder]].concat());
    assert_eq!(next().await, SampleKind::Put);
    assert_eq!(next().await, SampleKind::Delete, "it stays after its certificate has expired");

    certificates.renew("brief");
    assert_eq!(next().await, SampleKind::Put);
    evaluator.process.assert_said("make a new one soon");
}
