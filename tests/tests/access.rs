//! Who may come in: certificates, and what each role may do, at the router as it is shipped and at a learner that
//! listens itself.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Mutex, Once};
use std::time::{Duration, Instant};

use quad_tests::process::binary;
use quad_tests::router::protected_router;
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, peers};
use tempfile::{TempDir, tempdir};
use tokio::time::timeout;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Config, Session};

/// For what must not happen.
const LULL: Duration = Duration::from_millis(500);

/// What Zenoh logs in this process, where the routers are.
static LOG: Mutex<Vec<u8>> = Mutex::new(Vec::new());

struct Log;

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        LOG.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn wait_for_log(text: &str) {
    let what = format!("{text:?} in the router's log");
    eventually(&what, PATIENCE, || String::from_utf8_lossy(&LOG.lock().unwrap()).contains(text).then_some(()));
}

/// A folder of certificates, one of each role, besides an expired one.
struct Certificates {
    folder: TempDir,
}

impl Certificates {
    /// `None` if the test is to be skipped.
    fn make() -> Option<Certificates> {
        static START: Once = Once::new();
        START.call_once(|| {
            let filter = "zenoh=warn,zenoh::net::routing::interceptor=trace";
            tracing_subscriber::fmt().with_env_filter(filter).with_ansi(false).with_writer(|| Log).init();
        });
        let folder = tempdir().unwrap();
        let made: [&[&str]; 5] = [
            &["router", "router", "127.0.0.1"],
            &["learner", "learner"],
            &["evaluator", "evaluator"],
            &["monitor", "monitor"],
            &["--days", "0", "evaluator", "expired"],
        ];
        made.iter().all(|arguments| peers::certificates(folder.path(), arguments)).then_some(Certificates { folder })
    }

    /// An evaluator's that is valid for so many seconds, which the script's days are too long for.
    fn short(&self, name: &str, seconds: u64) {
        assert!(peers::certificates(self.folder.path(), &["evaluator", name]));
        let script = r#"
            touch index; openssl rand -hex 8 >serial
            printf '[ca]\ndefault_ca=it\n[it]\ndatabase=index\nserial=serial\nnew_certs_dir=.\npolicy=any\n[any]\n' >config
            printf 'organizationName=optional\norganizationalUnitName=optional\ncommonName=supplied\n' >>config
            printf 'extendedKeyUsage=clientAuth\n' >extensions
            openssl req -new -key "$2/key.pem" -subj /CN=quad-evaluator -out request
            openssl ca -batch -notext -config config -md sha256 -in request -cert ca/ca.pem -keyfile ca/key.pem \
              -extfile extensions -enddate "$(date -u -d "+$1 seconds" +%Y%m%d%H%M%SZ)" -out "$2/cert.pem"
        "#;
        let arguments = ["-euc", script, "sh", &seconds.to_string(), name];
        let output = Command::new("sh").args(arguments).current_dir(self.folder.path()).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }

    fn of(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn argument(&self, name: &str) -> String {
        self.of(name).to_str().unwrap().to_owned()
    }
}

/// Connects as whoever has the certificate in `folder`, or as nobody, and trusts the authority of `trusted`.
async fn connect(endpoint: &str, trusted: &Path, folder: Option<&Path>) -> zenoh::Result<Session> {
    let mut config = Config::default();
    let mut settings = vec![
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[{endpoint:?}]")),
        ("connect/timeout_ms", "2000".to_owned()),
        ("connect/exit_on_failure", "true".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("transport/link/tls/root_ca_certificate", format!("{:?}", trusted.join("ca.pem"))),
    ];
    if let Some(folder) = folder {
        settings.push(("transport/link/tls/enable_mtls", "true".to_owned()));
        settings.push(("transport/link/tls/connect_certificate", format!("{:?}", folder.join("cert.pem"))));
        settings.push(("transport/link/tls/connect_private_key", format!("{:?}", folder.join("key.pem"))));
    }
    for (key, value) in settings {
        config.insert_json5(key, &value).unwrap();
    }
    zenoh::open(config).await
}

/// The keys that arrive until `last` does.
async fn until(samples: &Subscriber<FifoChannelHandler<Sample>>, last: &str) -> Vec<String> {
    let mut keys = Vec::new();
    while keys.last().map(String::as_str) != Some(last) {
        let sample = timeout(PATIENCE, samples.recv_async()).await;
        keys.push(
            sample.unwrap_or_else(|_| panic!("{last} does not arrive, only {keys:?}")).unwrap().key_expr().to_string(),
        );
    }
    keys
}

/// Answers every question.
async fn answer(session: &Session, key: &str) -> Queryable<()> {
    let callback = |query: Query| {
        zenoh::Wait::wait(query.reply(query.key_expr().clone(), "an answer")).ok();
    };
    session.declare_queryable(key).callback(callback).await.unwrap()
}

/// How many answers there are.
async fn answers(session: &Session, key: &str) -> usize {
    let replies = session.get(key).timeout(LULL).await.unwrap();
    let mut count = 0;
    while let Ok(reply) = replies.recv_async().await {
        count += usize::from(reply.result().is_ok());
    }
    count
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_completes_through_the_shipped_router() {
    let Some(certificates) = Certificates::make() else { return };
    let (_router, endpoint) = protected_router(&certificates.of("router")).await;
    let (scratch, setting) = (Scratch::new(), Setting::default());
    let connect =
        |role| ["--connect".to_owned(), endpoint.clone(), "--certificates".to_owned(), certificates.argument(role)];
    let arguments = connect("evaluator");
    let _evaluator = scratch.evaluator_with("trusted", &arguments.each_ref().map(String::as_str));
    let arguments = connect("learner");
    let mut learner = scratch.learner_with("run", setting, &arguments.each_ref().map(String::as_str));
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_learner_that_listens_itself_asks_who_comes() {
    let Some(certificates) = Certificates::make() else { return };
    let (scratch, setting) = (Scratch::new(), Setting { steps: 100_000_000, eval_interval: 500, ..Setting::default() });
    let folder = certificates.argument("learner");
    let mut learner = scratch.learner_with("run", setting, &["--listen", "tls/127.0.0.1:0", "--certificates", &folder]);
    let (endpoint, authority) = (learner.endpoint(), certificates.of("learner"));
    assert!(endpoint.starts_with("tls/127.0.0.1:"), "{endpoint}");

    for (name, reason) in [(None, "peer sent no certificates"), (Some("expired"), "certificate expired")] {
        let folder = name.map(|name| certificates.of(name));
        assert!(connect(&endpoint, &authority, folder.as_deref()).await.is_err(), "{name:?} came in");
        learner.process.wait_for_log(reason, PATIENCE);
    }

    // Not even another learner may speak in this one's place; the reports of progress that come after are delivered.
    let witness = connect(&endpoint, &authority, Some(&certificates.of("monitor"))).await.unwrap();
    let heard = witness.declare_subscriber("quad/forged/**").await.unwrap();
    let rogue = connect(&endpoint, &authority, Some(&certificates.of("evaluator"))).await.unwrap();
    let asker = connect(&endpoint, &authority, Some(&certificates.of("evaluator"))).await.unwrap();
    let second = connect(&endpoint, &authority, Some(&certificates.of("learner"))).await.unwrap();
    for session in [&second, &rogue] {
        session.put("quad/forged/weights", "mine").await.unwrap();
        session.put("quad/forged/scores/1", "mine").await.unwrap();
        let _held = answer(session, "quad/forged/jobs").await;
        tokio::time::sleep(LULL).await;
        assert_eq!(answers(&asker, "quad/forged/jobs").await, 0);
    }
    eventually("the witness hears", PATIENCE, || {
        let put = rogue.put("quad/forged/progress/rogue", "half");
        zenoh::Wait::wait(put).unwrap();
        let sample = heard.recv_timeout(LULL).unwrap()?;
        assert_eq!(sample.key_expr().as_str(), "quad/forged/progress/rogue");
        Some(())
    });

    let folder = certificates.argument("evaluator");
    let _evaluator = scratch.evaluator_with("trusted", &["--connect", &endpoint, "--certificates", &folder]);
    eventually("there are scores", PATIENCE, || (learner.scores().len() > 12).then_some(()));
    assert!(learner.process.is_running());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_router_refuses_and_logs_those_without_a_valid_certificate() {
    let Some(certificates) = Certificates::make() else { return };
    let elsewhere = Certificates::make().unwrap();
    let (_router, endpoint) = protected_router(&certificates.of("router")).await;
    let (authority, evaluator) = (certificates.of("router"), certificates.of("evaluator"));
    // In all but the certificate they are what is let in.
    connect(&endpoint, &authority, Some(&evaluator)).await.expect("an evaluator is let in");
    let foreign = elsewhere.of("evaluator");
    let expired = certificates.of("expired");
    for (folder, reason) in [
        (None, "peer sent no certificates"),
        (Some(&foreign), "invalid peer certificate: UnknownIssuer"),
        (Some(&expired), "invalid peer certificate: certificate expired"),
    ] {
        let session = connect(&endpoint, &authority, folder.map(PathBuf::as_path)).await;
        assert!(session.is_err(), "{folder:?} came in");
        wait_for_log(reason);
    }

    // The other way round: a router that is not of the evaluator's authority, or only an evaluator, is not talked to.
    assert!(connect(&endpoint, &foreign, Some(&foreign)).await.is_err(), "a foreign router was trusted");
    let (_impostor, endpoint) = protected_router(&evaluator).await;
    assert!(connect(&endpoint, &authority, Some(&evaluator)).await.is_err(), "an evaluator passed for a router");

    // And it says so, instead of waiting in silence.
    let (scratch, folder) = (Scratch::new(), elsewhere.argument("evaluator"));
    let stray = scratch.evaluator_with("stray", &["--connect", &endpoint, "--certificates", &folder]);
    stray.process.wait_for_log("refuses the other's certificate", PATIENCE);
    assert!(!stray.process.log().contains("connected"));
}

#[tokio::test(flavor = "multi_thread")]
async fn each_role_may_do_what_it_is_for_and_nothing_else() {
    let Some(certificates) = Certificates::make() else { return };
    let (_router, endpoint) = protected_router(&certificates.of("router")).await;
    let authority = certificates.of("router");
    let mut sessions = Vec::new();
    for role in ["learner", "evaluator", "monitor", "monitor", "evaluator"] {
        sessions.push(connect(&endpoint, &authority, Some(&certificates.of(role))).await.unwrap());
    }
    let [learner, evaluator, monitor, listener, receiver] = &sessions[..] else { panic!("five sessions") };

    // What is put: each puts everything, and ends with what it may put. (A session hears itself whoever it is.)
    let heard = listener.declare_subscriber("quad/run/**").await.unwrap();
    let weights = receiver.declare_subscriber("quad/run/weights").await.unwrap();
    let spied = receiver.declare_subscriber("quad/run/progress/*").await.unwrap();
    tokio::time::sleep(LULL).await;
    let everything = ["weights", "scores/1", "progress/e", "jobs", "scores", "weights/1", "live/learner", "*", "**"];
    for key in everything {
        for session in [monitor, evaluator, learner] {
            session.put(format!("quad/run/{key}"), "words").await.unwrap();
        }
    }
    evaluator.put("quad/run/progress/e", vec![0; 5000]).await.unwrap();
    evaluator.delete("quad/run/progress/e").await.unwrap();
    // More than 25 a second are not passed on.
    tokio::time::sleep(Duration::from_millis(100)).await;
    evaluator.put("quad/run/progress/last", "words").await.unwrap();
    learner.put("quad/run/scores/2", "words").await.unwrap();
    let mut keys = until(&heard, "quad/run/progress/last").await;
    keys.extend(heard.drain().map(|sample| sample.key_expr().to_string()));
    if !keys.iter().any(|key| key == "quad/run/scores/2") {
        keys.extend(until(&heard, "quad/run/scores/2").await);
    }
    keys.sort();
    let allowed = ["progress/e", "progress/last", "scores/1", "scores/2", "weights"];
    assert_eq!(keys, allowed.map(|key| format!("quad/run/{key}")));
    assert_eq!(until(&weights, "quad/run/weights").await.len(), 1);
    assert!(weights.try_recv().unwrap().is_none() && spied.try_recv().unwrap().is_none());
    wait_for_log("is unauthorized to Put (ingress) on quad/run/weights");

    // Who answers: first those who may not.
    for impostor in [evaluator, monitor] {
        let _held = (answer(impostor, "quad/run/**").await, answer(impostor, "quad/run/jobs").await);
        tokio::time::sleep(LULL).await;
        assert_eq!(answers(receiver, "quad/run/jobs").await, 0, "{impostor:?}");
    }
    let mut held = Vec::new();
    for key in ["jobs", "scores", "weights/*"] {
        held.push(answer(learner, &format!("quad/run/{key}")).await);
    }
    for (key, for_evaluators, for_monitors) in [("jobs", 1, 0), ("scores", 1, 0), ("weights/7", 1, 1)] {
        let (key, deadline) = (format!("quad/run/{key}"), Instant::now() + PATIENCE);
        while answers(evaluator, &key).await != for_evaluators {
            assert!(Instant::now() < deadline, "{key} is not answered");
        }
        assert_eq!(answers(monitor, &key).await, for_monitors, "{key}");
    }

    // Who is there.
    for impostor in [evaluator, monitor] {
        held_for_good(impostor.liveliness().declare_token("quad/forged/live/learner").await.unwrap());
    }
    for (session, key) in [(learner, "quad/run/live/learner/1"), (evaluator, "quad/run/live/evaluator/e")] {
        held_for_good(session.liveliness().declare_token(key).await.unwrap());
    }
    held_for_good(monitor.liveliness().declare_token("quad/run/live/evaluator/m").await.unwrap());
    tokio::time::sleep(LULL).await;
    let tokens = listener.liveliness().get("quad/**").timeout(LULL).await.unwrap();
    let mut there = Vec::new();
    while let Ok(reply) = tokens.recv_async().await {
        there.push(reply.result().unwrap().key_expr().to_string());
    }
    there.sort();
    assert_eq!(there, ["quad/run/live/evaluator/e", "quad/run/live/learner/1"]);
}

/// Until the test's end.
fn held_for_good<T>(value: T) {
    std::mem::forget(value);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_expired_certificate_ends_a_connection_and_a_renewed_one_brings_it_back() {
    let Some(certificates) = Certificates::make() else { return };
    let (_router, endpoint) = protected_router(&certificates.of("router")).await;
    let monitor = connect(&endpoint, &certificates.of("router"), Some(&certificates.of("monitor"))).await.unwrap();
    let tokens = monitor.liveliness().declare_subscriber("quad/run/live/evaluator/*").history(true).await.unwrap();
    let next = async || timeout(PATIENCE, tokens.recv_async()).await.expect("nobody comes or goes").unwrap().kind();

    let (scratch, endless) = (Scratch::new(), Setting { steps: 100_000_000, eval_interval: 500, ..Setting::default() });
    let folder = certificates.argument("learner");
    let _learner = scratch.learner_with("run", endless, &["--connect", &endpoint, "--certificates", &folder]);
    certificates.short("brief", 15);
    let folder = certificates.argument("brief");
    let evaluator = scratch.evaluator_with("brief", &["--connect", &endpoint, "--certificates", &folder]);
    assert_eq!(next().await, SampleKind::Put);
    assert_eq!(next().await, SampleKind::Delete, "it stays after its certificate has expired");

    assert!(peers::certificates(certificates.folder.path(), &["evaluator", "brief"]));
    assert_eq!(next().await, SampleKind::Put);
    assert!(evaluator.process.log().contains("make a new one soon"));
}

#[test]
fn what_cannot_be_safe_is_refused_before_anything_starts() {
    let Some(certificates) = Certificates::make() else { return };
    let elsewhere = Certificates::make().unwrap();
    let scratch = Scratch::new();
    let preset = scratch.preset("run", Setting::default());
    // Whatever would start nevertheless is stopped, with exit code 124.
    let start = |program: &str| {
        let mut command = Command::new("timeout");
        command.arg(PATIENCE.as_secs().to_string()).arg(binary(program));
        command
    };
    let learner = |arguments: &[&str]| {
        let mut command = start("learner");
        command.arg("train").arg("--preset").arg(&preset).arg("--dataset").arg(scratch.dataset());
        command.arg("--run-dir").arg(scratch.path().join("run")).args(arguments).output().unwrap()
    };
    let evaluator = |arguments: &[&str]| start("evaluator").arg("serve").args(arguments).output().unwrap();
    let (good, tls) = (certificates.argument("evaluator"), format!("tls/127.0.0.1:{}", free_port()));

    let open = evaluator(&["--connect", "tcp/127.0.0.1:1", "--certificates", &good]);
    assert_refused(&open, "tcp/127.0.0.1:1 would be open to anybody", "tls/HOST:PORT");
    let open = learner(&["--listen", "tcp/127.0.0.1:0", "--certificates", &certificates.argument("learner")]);
    assert_refused(&open, "tcp/127.0.0.1:0 would be open to anybody", "tls/HOST:PORT");
    assert_refused(&evaluator(&["--connect", &tls]), "needs certificates", "--certificates DIR");
    assert_refused(&learner(&["--listen", &tls]), "needs certificates", "--certificates DIR");

    let with = |folder: &Path| evaluator(&["--connect", &tls, "--certificates", folder.to_str().unwrap()]);
    assert_refused(&with(&certificates.of("nowhere")), "nowhere/ca.pem", "certificates.sh");
    assert_refused(&with(&certificates.of("learner")), "is a certificate for quad-learner", "this program's role");
    assert_refused(&with(&certificates.of("expired")), "which is not now", "make a new certificate");
    let mixed = certificates.of("mixed");
    fs::create_dir(&mixed).unwrap();
    for (from, file) in [(&elsewhere, "ca.pem"), (&certificates, "cert.pem"), (&certificates, "key.pem")] {
        fs::copy(from.of("evaluator").join(file), mixed.join(file)).unwrap();
    }
    assert_refused(&with(&mixed), "is of another authority", "ca.pem");
    fs::write(mixed.join("key.pem"), "a secret").unwrap();
    assert_refused(&with(&mixed), "key.pem holds no private key", "ca.pem");
    let swapped = learner(&["--listen", &tls, "--certificates", &good]);
    assert_refused(&swapped, "is a certificate for quad-evaluator", "this program's role");
    assert!(!scratch.path().join("run").exists(), "a refused start leaves a folder behind");

    // The environment variable is the flag, and without an endpoint the default one is protected.
    let mut command = start("evaluator");
    command.arg("serve").env("QUAD_CERTIFICATES", certificates.of("nowhere"));
    assert_refused(&command.output().unwrap(), "nowhere/ca.pem", "certificates.sh");
}

fn assert_refused(output: &Output, sentence: &str, hint: &str) {
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{sentence}: {text}");
    let advice = text.split_once("hint: ").map(|(_, advice)| advice).unwrap_or_default();
    assert!(text.contains(sentence), "`{sentence}` is not in\n{text}");
    assert!(advice.contains(hint), "`{hint}` is not in the hint of\n{text}");
}
