//! Programs that may connect: those with a certificate, at the router as it is shipped and at a
//! learner that listens itself.

use std::thread::sleep;
use std::time::{Duration, Instant};

use quad_tests::certificates::{Certificates, connect, try_to_connect};
use quad_tests::router::protected_router;
use quad_tests::setting::{ENDLESS, IDLE, SHORT, Setting};
use quad_tests::system::Scratch;
use quad_tests::wait_until;

/// Host of the router's certificate.
pub const HOST: &str = "127.0.0.1";

#[tokio::test(flavor = "multi_thread")]
async fn an_online_run_completes_through_the_shipped_router() {
    let Some(certificates) = Certificates::make() else { return };
    let (_router, endpoint) = protected_router(HOST, &certificates.path("router")).await;
    let scratch = Scratch::new();
    let [ours, theirs] = ["learner", "evaluator"].map(|role| certificates.path(role));
    let connect = ["--connect", &endpoint, "--certificates"];
    let _evaluator = scratch.evaluator_with("trusted", &[&connect[..], &[&theirs]].concat());
    let setting = Setting { eval_interval: 250, online_steps: 300, ..SHORT };
    let mut learner = scratch.learner_with("run", setting, &[&connect[..], &[&ours]].concat());
    learner.assert_completes();
}

#[tokio::test(flavor = "multi_thread")]
async fn only_valid_certificates_are_let_in() {
    let Some(certificates) = Certificates::make() else { return };
    let elsewhere = Certificates::make().unwrap();
    let (_router, router) = protected_router(HOST, &certificates.path("router")).await;
    let (scratch, folder) = (Scratch::new(), certificates.path("learner"));
    let listen = ["--listen", "tls/127.0.0.1:0", "--certificates", &folder];
    let learner = scratch.learner_with("run", ENDLESS, &listen);
    let (authority, evaluator) = (certificates.path("router"), certificates.path("evaluator"));
    let (foreign, expired) = (elsewhere.path("evaluator"), certificates.path("expired"));
    for endpoint in [router, learner.endpoint()] {
        for folder in [None, Some(&*expired), Some(&*foreign)] {
            let session = try_to_connect(&endpoint, &authority, folder).await;
            assert!(session.is_err(), "{folder:?} came in at {endpoint}");
        }
        // In all but the certificate it is what is refused.
        connect(&endpoint, &authority, &evaluator).await;
    }
    let folder = certificates.path("evaluator");
    let trusted = ["--connect", &learner.endpoint(), "--certificates", &folder];
    let _evaluator = scratch.evaluator_with("trusted", &trusted);
    learner.wait_for_scores(1);
}

/// One of another authority, one that is only an evaluator, and one of another host.
#[tokio::test(flavor = "multi_thread")]
async fn evaluators_refuse_impostors_of_a_router_and_say_so() {
    let Some(certificates) = Certificates::make() else { return };
    let elsewhere = Certificates::make().unwrap();
    let scratch = Scratch::new();
    for (name, host, shown) in [
        ("foreign", HOST, elsewhere.path("router")),
        ("evaluator", HOST, certificates.path("evaluator")),
        ("host", "127.0.0.2", certificates.path("router")),
    ] {
        let (_router, endpoint) = protected_router(host, &shown).await;
        let folder = certificates.path("evaluator");
        let connect = ["--connect", &endpoint, "--certificates", &folder];
        let evaluator = scratch.evaluator_with(name, &connect);
        evaluator.wait_for_log("refuses the other's certificate");
        evaluator.assert_not_said("connected");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_expired_certificate_ends_a_connection_and_a_renewed_one_brings_it_back() {
    let Some(certificates) = Certificates::make() else { return };
    let (scratch, folder) = (Scratch::new(), certificates.path("learner"));
    let (_router, endpoint) = protected_router(HOST, &certificates.path("router")).await;
    let flags = ["--connect", &endpoint, "--certificates"];
    let learner = scratch.learner_with("run", IDLE, &[&flags[..], &[&folder]].concat());
    let is_there = || learner.metric("evaluators", "") == Some(1.0);
    let folder = certificates.path("brief");
    let mut seconds = 10;
    let evaluator = loop {
        certificates.make_brief("brief", seconds);
        let evaluator = scratch.evaluator_with("brief", &[&flags[..], &[&folder]].concat());
        let expiry = Instant::now() + Duration::from_secs(seconds);
        while !is_there() && Instant::now() < expiry {
            sleep(Duration::from_millis(20));
        }
        if is_there() {
            break evaluator;
        }
        // A busy machine takes longer to connect.
        seconds *= 4;
    };
    wait_until("it leaves when its certificate expires", || !is_there());
    certificates.run_script(&["evaluator", "brief"]);
    wait_until("it comes back", is_there);
    evaluator.assert_said("make a new one soon");
}
