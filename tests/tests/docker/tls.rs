//! Compose with docker-compose.tls.yml on top: a run is complete, and an evaluator without a certificate has no part in it.

use std::os::unix::fs::chown;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use quad_tests::peers;
use tempfile::tempdir;

use crate::compose::{Compose, LIGHT, docker, logs, wait_for_log};

/// The containers' user.
const USER: u32 = 10001;

/// What the first lines of docker-compose.tls.yml tell to do; false if the test is to be skipped.
fn certificates(folder: &Path) -> bool {
    let roles: [&[&str]; 3] = [&["router", "router", "router"], &["learner", "learner"], &["evaluator", "evaluator"]];
    roles.iter().all(|role| {
        peers::certificates(folder, role) && {
            let folder = folder.join(role[1]);
            let mut files = ["", "ca.pem", "cert.pem", "key.pem"].iter().map(|file| folder.join(file));
            let given = files.try_for_each(|file| chown(file, Some(USER), None));
            given.inspect_err(|error| eprintln!("skipped, because of chown: {error}")).is_ok()
        }
    })
}

#[test]
#[ignore = "five minutes, after the images"]
fn compose_with_certificates_works_and_lets_in_no_others() {
    let (ours, theirs) = (tempdir().unwrap(), tempdir().unwrap());
    if !(certificates(ours.path()) && certificates(theirs.path())) {
        return;
    }
    let Some(mut compose) = Compose::project("tls", &format!("{LIGHT} --steps 8000 --eval-interval 1000")) else {
        return;
    };
    let begin = Instant::now();
    compose.set("COMPOSE_FILE", "docker-compose.yml:docker-compose.tls.yml");
    compose.set("QUAD_CERTIFICATES_ROOT", ours.path().to_str().unwrap());
    compose.run(&["up", "--detach", "learner"]);
    wait_for_log(&compose.container("learner"), "snapshot handed to evaluation", 1);

    // There is work, and at first only evaluators without a certificate of ours to do it.
    let network = compose.network();
    let stranger = |endpoint: &str, options: &[&str]| {
        let evaluator = ["quad/evaluator", "serve", "--name", "stranger", "--connect", endpoint];
        let arguments = [&["run", "--detach", "--network", &network], options, &evaluator].concat();
        Stranger(docker(&arguments).trim().to_owned())
    };
    let folder = format!("{}:/certificates:ro", theirs.path().join("evaluator").display());
    let foreign = ["--volume", &folder, "--env", "QUAD_CERTIFICATES=/certificates"];
    let strangers = [stranger("tcp/router:7447", &[]), stranger("tls/router:7447", &foreign)];
    for stranger in &strangers {
        wait_for_log(&stranger.0, "no connection to", 1);
    }

    compose.run(&["up", "--detach", "--no-recreate", "evaluator"]);
    let verdict = compose.assert_run_is_complete("tls");
    assert!(verdict.contains("32 of 32 episodes are scored"), "{verdict}");
    let scores = compose.learner("cat /runs/tls/scores.jsonl");
    assert!(!scores.contains("stranger"), "{scores}");
    for stranger in &strangers {
        assert!(!logs(&stranger.0).contains("connected"), "{}", logs(&stranger.0));
    }
    eprintln!("{verdict} ({:.0?})", begin.elapsed());
}

/// A container that is not of the project.
struct Stranger(String);

impl Drop for Stranger {
    fn drop(&mut self) {
        Command::new("docker").args(["rm", "--force", &self.0]).stdout(Stdio::null()).status().ok();
    }
}
