//! The learner's command lines and what they print: the transcripts beside this file, on runs that
//! are made up here and in runs.toml. `TRYCMD=overwrite cargo test …` writes anew what is printed.
#![allow(clippy::unwrap_used, clippy::expect_used)]

#[path = "../../../tests/fixtures/hopper.rs"]
mod hopper;
mod run;

use std::env;
use std::fs::{self, File, Permissions};
use std::net::TcpListener;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::process::Command;

use quad_dataset::{Arrays, Names, write_own};
use quad_protocol::{Episode, Hash, Name, encode, episode_seeds, online_seed};
use quad_run::folder::RunDir;
use quad_run::results::{Conditions, Estimate, Judgment};

use run::{Run, write_runs};

const LEARNER: &str = env!("CARGO_BIN_EXE_learner");

#[test]
fn commands_print_what_their_transcripts_have() {
    let folder = tempfile::tempdir().unwrap();
    env::set_current_dir(folder.path()).unwrap();
    hopper::write_hopper(Path::new("data.hdf5"), 2, 50);
    write_far(Path::new("far.hdf5"));
    write_runs();
    fs::write("list/study/half/metrics.jsonl", "{\"step\":30,\"seconds\":1.5}\n").unwrap();
    fs::create_dir("list/other").unwrap();
    fs::write("list/other/config.toml", "[model]\nname = 'x'\n").unwrap();
    for damaged in ["list/damaged", "foreign/terminal/damaged\u{1b}]0;x\u{7}"] {
        fs::write(format!("{damaged}/scores.jsonl"), "{\"step\":10}\n").unwrap();
    }
    // As by a learner at work.
    let at_work = File::open("list/study/half/scores.jsonl").unwrap();
    at_work.lock().unwrap();
    // Where this fails, another program has the port.
    let _usual_port = TcpListener::bind("127.0.0.1:7447");
    write_verified();
    write_experience();
    write_films();
    write_exported();
    // Its arguments are the lines of a shell's script.
    fs::write("script", "#!/bin/sh\nIFS='\n'; script=\"$*\"; unset IFS; eval \"$script\"\n")
        .unwrap();
    fs::set_permissions("script", Permissions::from_mode(0o755)).unwrap();
    trycmd::TestCases::new()
        .register_bin("learner", Path::new(LEARNER))
        .register_bin("sh", Path::new("/bin/sh"))
        .register_bin("script", folder.path().join("script"))
        .env("PATH", bin_path())
        .env("LC_ALL", "C")
        .env("STUDIES", concat!(env!("CARGO_MANIFEST_DIR"), "/../studies"))
        .case(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/cli/*.trycmd"))
        .run();
}

/// A dataset of which one observation is far from all others.
fn write_far(path: &Path) {
    let numbers = |count: usize| Vec::from_iter((0..count).map(|i| (i as f32).sin() / 2.0));
    let mut observations = numbers(200);
    observations[0] = 1e12;
    let arrays = Arrays {
        observation_dim: 2,
        action_dim: 1,
        next_observations: numbers(202).split_off(2),
        observations,
        actions: numbers(100),
        rewards: vec![1.0; 100],
        terminals: vec![false; 100],
        timeouts: (1..=100).map(|row| row % 25 == 0).collect(),
    };
    write_own(path, arrays, Names::default()).unwrap();
}

/// The search path with the learner, for pipes.
fn bin_path() -> String {
    let folder = Path::new(LEARNER).parent().unwrap();
    format!("{}:{}", folder.display(), env::var("PATH").unwrap())
}

/// The runs of verify.trycmd, of 15 steps: one with evaluations of three episodes, and as with
/// `--eval-interval 0` some with a snapshot alone, one of which is judged.
fn write_verified() {
    for (name, eval_interval) in [("whole", 10), ("alone", 0), ("judged", 0)] {
        let mut run = Run::new(&toml::toml! {
            seed = 4
            "experiment.steps" = 15
            "experiment.eval_interval" = eval_interval
            "experiment.episodes" = 3
        });
        let folder = RunDir::at(&Path::new("verify").join(name));
        for step in [10, 15].into_iter().filter(|step| *step == 15 || eval_interval > 0) {
            let snapshot = [step as u8; 100];
            let weights = Hash::new(&snapshot).to_string();
            if eval_interval > 0 {
                episode_seeds(4, step, 3)
                    .iter()
                    .for_each(|seed| run.score(step, *seed, 1.5, &weights));
            }
            run.write(folder.path());
            folder.write_snapshot(step, &snapshot).unwrap();
            if name == "judged" {
                judge(&folder, step, 1.0, &weights);
            }
        }
    }
}

/// The experience of the runs of export-data.trycmd: three episodes, in the first of which a person
/// acted twice, and the same without that person; the first with a sensor's glitch; one of another
/// precision; a wrong and a doubled seed; and one without observations, of another user's.
fn write_experience() {
    let append = |run: &str, episode: &Episode| {
        let (mut log, _) = RunDir::at(Path::new(run)).experience_log().unwrap();
        log.append([&*encode(episode).unwrap()]).unwrap();
    };
    let precision = Name::new("f32-avx512").unwrap();
    let new = |number| {
        let seed = online_seed(5, number);
        Episode::new(20_000, Hash::new(b"weights"), precision.clone(), seed)
    };
    for (number, rows) in [(0, 30), (1, 60), (2, 20)] {
        let smooth = |count: usize, each: f32| {
            Vec::from_iter((0..count).map(|i| ((i + 40 * number) as f32 * each).sin()))
        };
        let mut episode = new(number as u64);
        (episode.score.episode_return, episode.score.score) = (rows as f64, 1.0);
        episode.score.length = rows as u32;
        episode.terminated = number != 1;
        episode.observations = smooth((rows + 1) * 11, 0.37);
        episode.actions = smooth(rows * 3, 1.3);
        episode.rewards = smooth(rows, 0.1);
        for run in ["plain", "mixed", "strange"] {
            let mut episode = episode.clone();
            match (run, number) {
                ("mixed", 1) => episode.precision = Name::new("f32-avx2").unwrap(),
                ("strange", 1) => episode.score.seed = 1,
                ("strange", 2) => episode.score.seed = online_seed(5, 0),
                _ => {}
            }
            append(&format!("online/{run}"), &episode);
        }
        if number == 0 {
            episode.interventions = vec![3, 4];
        }
        append("online/run", &episode);
        if number == 0 {
            episode.observations[0] = 1e12;
            append("online/far", &episode);
        }
    }
    let mut empty = new(0);
    (empty.actions, empty.rewards, empty.score.length) = (vec![0.5; 3], vec![1.0], 1);
    append("online/foreign", &empty);
}

/// The run of export.trycmd: trained, with two equal snapshots of other scores and judgments.
fn write_exported() {
    let words = "train --task hopper-demo --dataset data.hdf5 --run-dir exported/run --steps 10 --episodes 2 --eval-interval 0 \
                 --set batch_size=8 --agent actor.hidden=[8] --agent critic.hidden=[8]";
    let mut learner = Command::new(LEARNER);
    let output = learner.args(words.split_whitespace()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let run = RunDir::at(Path::new("exported/run"));
    fs::copy(run.snapshot_path(10), run.snapshot_path(5)).unwrap();
    let weights = Hash::new(&run.read_snapshot(10).unwrap()).to_string();
    let mut scored = Run::new(&toml::Table::new());
    for (step, score) in [(5, 30.0), (10, 20.0)] {
        (0..2).for_each(|seed| scored.score(step, seed, score, &weights));
        judge(&run, step, step as f64, &weights);
    }
    fs::write("exported/run/scores.jsonl", scored.lines()).unwrap();
}

fn judge(run: &RunDir, step: u64, distance: f64, weights: &str) {
    let estimate = Estimate { values: vec![1.0, 1.0], doubts: Vec::new() };
    let judgment = Judgment {
        run: run.path().to_owned(),
        step,
        weights: weights.to_owned(),
        conditions: Conditions {
            dataset: "abc".to_owned(),
            environment: "hopper".to_owned(),
            episodes: vec![0],
            gamma: 0.99,
            steps: 100,
            seeds: 2,
        },
        estimate: estimate.clone(),
        distance,
        unseen: true,
        caveat: Some("it executes 2 actions".to_owned()),
        behavior: estimate,
        recorded: 1.0,
    };
    judgment.save(run).unwrap();
}

/// Films in the folders of foreign.trycmd.
fn write_films() {
    fs::write("secret.gif", "GIF89a secret of the report's reader").unwrap();
    fs::write("foreign/text/film.gif", "a secret").unwrap();
    fs::copy("secret.gif", "foreign/film/film.gif").unwrap();
    symlink("../../secret.gif", "foreign/link/film.gif").unwrap();
}
