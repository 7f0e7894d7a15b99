//! The whole system as `docker compose up` runs it, from the images on.
//!
//! Base images come from a registry or, where there is none, from a script that makes stand-ins for them: the one that
//! QUAD_STAND_INS names, else ../shared/docker/stand-ins. Building takes minutes, so this runs only when asked for.
#![allow(clippy::expect_used, clippy::print_stderr)]

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use quad_tests::prometheus::Prometheus;
use quad_tests::{dashboard, eventually};
use serde_json::Value;

const EVALUATORS: usize = 4;
const EPISODES: usize = 8;
const PATIENCE: Duration = Duration::from_secs(240);
const TRAINING: Duration = Duration::from_secs(1800);

#[test]
#[ignore = "builds the images, which takes minutes: cargo test --release -p quad-tests --test docker -- --ignored"]
fn compose_runs_the_whole_system() {
    if let Err(reason) = base_images() {
        eprintln!("skipped, because {reason}");
        return;
    }
    let compose = Compose { project: format!("quad-test-{}", std::process::id()) };
    compose.run(&["up", "--build", "--detach", "--scale", "evaluator=4", "--scale", "grafana=0"]);

    let prometheus = Prometheus { address: compose.run(&["port", "prometheus", "9090"]).trim().to_owned() };
    for (job, count) in [("learner", 1), ("evaluator", EVALUATORS)] {
        let expression = format!("sum(up{{job={job:?}}})");
        eventually(&expression, PATIENCE, || prometheus.value(&expression).filter(|up| *up == count as f64));
    }
    dashboard::assert_every_panel_shows_data(&prometheus, PATIENCE);

    let containers = |service: &str| -> Vec<String> {
        compose.run(&["ps", "--all", "--quiet", service]).lines().map(str::to_owned).collect()
    };
    let learner = containers("learner").remove(0);
    let evaluators = containers("evaluator");
    assert_eq!(evaluators.len(), EVALUATORS);
    for container in evaluators.iter().chain([&learner]).chain(&containers("router")).chain(&containers("prometheus")) {
        let state = docker(&["inspect", "--format", "{{.State.Health.Status}} {{.Config.User}}", container]);
        let (health, user) = state.trim().split_once(' ').expect("two words");
        assert_eq!(health, "healthy", "{container}");
        assert!(!["", "0", "root"].contains(&user), "{container} runs as {user:?}");
    }

    let exit_code = eventually("the learner ended", TRAINING, || {
        let state = docker(&["inspect", "--format", "{{.State.Status}} {{.State.ExitCode}}", &learner]);
        state.trim().strip_prefix("exited ").map(str::to_owned)
    });
    assert_eq!(exit_code, "0", "the learner's exit code");
    let scores =
        compose.run(&["run", "--rm", "--no-deps", "--entrypoint", "cat", "learner", "/runs/test/scores.jsonl"]);
    let scores: Vec<Value> = scores.lines().map(|line| serde_json::from_str(line).expect("a JSON object")).collect();
    let distinct = |fields: &[&str]| -> usize {
        scores
            .iter()
            .map(|score| fields.iter().map(|field| score[field].to_string()).collect())
            .collect::<HashSet<Vec<_>>>()
            .len()
    };
    assert_eq!(scores.len(), distinct(&["step"]) * EPISODES);
    assert_eq!(scores.len(), distinct(&["step", "seed"]), "a (step, seed) has two scores");
    assert!(distinct(&["evaluator"]) > 1, "one evaluator did all the work");
}

/// A system of its own, on ports that Docker chooses; gone with its volumes when dropped.
struct Compose {
    project: String,
}

impl Compose {
    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new("docker");
        command.current_dir(repository()).args(["compose", "--project-name", &self.project]).args(arguments);
        command.envs([
            ("QUAD_ROUTER_PORT", "0"),
            ("QUAD_PROMETHEUS_PORT", "0"),
            ("QUAD_GRAFANA_PULL", "never"),
            ("QUAD_RUN", "test"),
            ("QUAD_COLLECT_ARGS", "--transitions 20000"),
            ("QUAD_TRAIN_ARGS", &format!("--steps 12000 --eval-interval 1000 --episodes {EPISODES}")),
        ]);
        command.stdin(Stdio::null()).stderr(Stdio::inherit());
        command
    }

    fn run(&self, arguments: &[&str]) -> String {
        output(self.command(arguments))
    }
}

impl Drop for Compose {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.command(&["logs", "--tail", "30"]).status().ok();
        }
        self.command(&["down", "--volumes", "--timeout", "5"]).status().ok();
    }
}

fn docker(arguments: &[&str]) -> String {
    let mut command = Command::new("docker");
    command.args(arguments).stderr(Stdio::inherit());
    output(command)
}

fn output(mut command: Command) -> String {
    let output = command.output().expect("docker was found before");
    assert!(output.status.success(), "{command:?} ended with {}", output.status);
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Makes sure that the images which ours are made from, and those of router and Prometheus, are on this machine.
fn base_images() -> Result<(), String> {
    let succeeds = |command: &mut Command| command.stdout(Stdio::null()).status().is_ok_and(|status| status.success());
    if !succeeds(Command::new("docker").arg("info").stderr(Stdio::null())) {
        return Err("no Docker engine answers".to_owned());
    }
    let named = ["docker-compose.yml", "deploy/Dockerfile"]
        .map(|file| std::fs::read_to_string(repository().join(file)).expect("the repository has its files"));
    let images: Vec<&str> = named
        .iter()
        .flat_map(|text| text.lines())
        .filter_map(|line| line.trim().strip_prefix("image: ").or(line.strip_prefix("FROM "))?.split(' ').next())
        // Our own and the Dockerfile's stages have no tag; Grafana is scaled to none.
        .filter(|image| image.contains(':') && !image.starts_with("grafana/"))
        .collect();
    let beside = repository().join("../shared/docker/stand-ins");
    let stand_ins = std::env::var_os("QUAD_STAND_INS").map_or(beside, PathBuf::from);
    if stand_ins.exists() {
        return match succeeds(Command::new(&stand_ins).args(&images)) {
            true => Ok(()),
            false => Err(format!("{} failed", stand_ins.display())),
        };
    }
    for image in images {
        let there = succeeds(Command::new("docker").args(["image", "inspect", image]).stderr(Stdio::null()));
        if !there && !succeeds(Command::new("docker").args(["pull", "--quiet", image])) {
            return Err(format!("{image} can be had neither from a registry nor from a script for stand-ins"));
        }
    }
    Ok(())
}
