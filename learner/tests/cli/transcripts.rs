//! Command lines and what they print: the transcripts beside this file, on runs that are made up
//! here. `TRYCMD=overwrite cargo test …` writes anew what is printed.

use std::env;
use std::fs::{self, File};
use std::net::TcpListener;
use std::os::unix::fs::symlink;
use std::path::Path;

use quad_dataset::{Arrays, Names, write_own};
use quad_protocol::{Episode, EpisodeScore, Hash, Name, encode, episode_seeds};
use quad_run::folder::RunDir;
use serde_json::{Value, json};

use crate::export::judge;
use crate::run::{
    HOPPER, Run, TASKS, complete, fallen, online, paper, small, write_all, write_study,
};
use crate::write_dataset;

/// A study whose run diverges at its last step: one observation is too large for the square of a
/// gradient.
const DIVERGES: &str = "about = 'x'
[run]
task = 'own-data'
environment = 'far'
dataset = 'far.hdf5'
algorithm = 'td3-bc'
hold_out = 0
steps = 20
batch_size = 8
agent.actor.hidden = [8]
agent.critic.hidden = [8]
[axes]
seed = [0]
";

/// A study of which some runs cannot begin.
const STUDY: &str = "about = 'x'
[run]
task = 'hopper-demo'
dataset = 'data.hdf5'
steps = 10
eval_interval = 0
agent.actor.hidden = [8]
agent.critic.hidden = [8]
[axes]
method = ['large', 'absent', 'small']
seed = [0]
[method.large]
batch_size = 999999
[method.absent]
dataset = 'absent.hdf5'
[method.small]
batch_size = 8
";

#[test]
fn commands_print_what_their_transcripts_have() {
    let folder = tempfile::tempdir().unwrap();
    env::set_current_dir(folder.path()).unwrap();
    write_dataset(Path::new("data.hdf5"));
    fs::write("study.toml", STUDY).unwrap();
    fs::write("diverges.toml", DIVERGES).unwrap();
    write_far(Path::new("far.hdf5"));
    write_reported();
    write_published();
    write_studies();
    let _at_work = write_listed();
    // Where this fails, another program has the port.
    let _usual_port = TcpListener::bind("127.0.0.1:7447");
    write_verified();
    write_online_runs();
    write_foreign();
    trycmd::TestCases::new()
        .register_bin("learner", Path::new(env!("CARGO_BIN_EXE_learner")))
        .register_bin("sh", Path::new("/bin/sh"))
        .env("PATH", bin_path())
        .env("LC_ALL", "C")
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
    let folder = Path::new(env!("CARGO_BIN_EXE_learner")).parent().unwrap();
    format!("{}:{}", folder.display(), env::var("PATH").unwrap())
}

/// The runs of report.trycmd.
fn write_reported() {
    small(3, 0.0).write("report/one");
    online().write("report/online");
    fallen().write("report/fallen");
    let (mut complete, mut stopped) = (small(0, 0.0), small(1, 0.0));
    complete.score(6000, 0, 12.0, "00");
    complete.write("report/stopped/a");
    stopped.scores.truncate(4);
    stopped.write("report/stopped/b");
    let mut unscored = small(1, 0.0);
    unscored.scores.clear();
    small(0, 0.0).write("report/twice/a");
    small(0, 4.0).write("report/twice/b");
    unscored.write("report/twice/0");
    let mut best = small(0, 0.0);
    (0..2).for_each(|episode| best.score(7000, episode, 10.0, "00"));
    best.write("report/best");
    let mut robot = small(0, 0.0).set("experiment.environment", "my-robot");
    let dataset = robot.config["dataset"].as_table_mut();
    dataset.unwrap().remove("mean_score");
    robot.write("report/robot");
    robot.scores_are_returns().write("report/returns");
    small(0, 0.0).write("report/unlike/first");
    let unlike = |key: &str, value: toml::Value| {
        small(1, 0.0).set(key, value).write(format!("report/unlike/{key}"));
    };
    unlike("experiment.agent.tau", 0.5.into());
    unlike("experiment.agent.candidates", 1.into());
    unlike("run.device", "cuda".into());
    unlike("dataset.mean_return", 21.0.into());
    unlike("experiment.agent.eta.threshold", 1.0.into());
    unlike("experiment.reward", "as-is".into());
    unlike("experiment.normalize", vec!["observations"].into());
    // The same file in another place.
    unlike("dataset.path", "elsewhere.hdf5".into());
    // The evaluation after 50,000 steps is none of the last 50,000.
    let mut last = Run::new("hopper-demo", 0).sizes(100_000, 10_000, 1);
    (1..=10).for_each(|n| last.score(10_000 * n, 0, n as f64, "00"));
    last.write("report/last");
    // Of these 50,000, online learning has 10,000.
    let online = online().config["experiment"]["online"].clone();
    let online = last.set("experiment.steps", 90_000).set("experiment.online", online);
    let online = online.set("experiment.online.steps", 5500);
    online.write("report/short-online");
    write_all("report/goals", paper("antmaze-umaze-v0", 100_000, |_| 50.0));
}

/// The runs of published.trycmd.
fn write_published() {
    // The last five: 1,920,000 to 2,000,000. An early best one counts only where it is asked for.
    let score = |step| if step == 20_000 { 1000.0 } else { step as f64 / 20_000.0 };
    write_all("paper", paper(HOPPER, 2_000_000, score));
    write_all("large", paper("antmaze-large-diverse-v0", 20_000, |_| 50.0));
    let complete = || paper(HOPPER, 2_000_000, |_| 50.0);
    let changed = paper(HOPPER, 400_000, |_| 50.0)
        .remove(0)
        .set("experiment.dataset", "x.hdf5")
        .set("experiment.agent.tau", 1.0)
        .set("experiment.normalize", vec!["observations"]);
    changed.write("departures/changed");
    // The named file in another place, known by its checksum.
    let sha256 = "e121c5f7c9857a307baa9edc6a2c3b48e85fedb9ac316ecddd0f48ca7ef4e39b";
    changed.set("dataset.sha256", sha256).write("departures/copied");
    let mut mixed = complete();
    mixed[1].scores.iter_mut().for_each(|line| line["precision"] = json!("bf16-amx"));
    write_all("mixed", mixed);
    for guidance in ["dac", "none"] {
        let guided = |run: Run| run.set("experiment.agent.guidance", guidance);
        write_all(guidance, complete().into_iter().map(guided));
    }
    let mut iql = Run::by("iql", HOPPER, 0).set("experiment.agent.expectile", 0.8);
    (0..10).for_each(|episode| iql.score(5_000, episode, 50.0, "00"));
    iql.write("two/iql");
    paper(HOPPER, 100_000, |_| 50.0)[0].write("two/quad");
    let mut cube = Run::by("fql", "cube-single-play-singletask-v0", 0);
    cube = cube.set("experiment.episodes", 1);
    (1..=10).for_each(|n| cube.score(100_000 * n, 0, n as f64, "00"));
    cube.write("others/cube");
    Run::by("td3-bc", "hopper-medium-v2", 0).write("others/td3-bc");
    write_all("before/a", paper(HOPPER, 400_000, |_| 30.0));
    write_all("before/b", complete());
}

/// The studies of study.trycmd.
fn write_studies() {
    write_study("study");
    // Task, environment and τ of each run; the τ of hopper-demo is 0.1.
    let (own, walker) = ((TASKS[0], "hopper", 0.1), (TASKS[1], "walker2d", 0.5));
    for (name, runs) in [
        ("half-done", vec![own, walker]),
        ("two-values", vec![own, (TASKS[0], "hopper", 0.5), walker]),
        ("unknown", vec![("mine-a", "hopper", 0.1), ("mine-b", "walker2d", 0.5)]),
        ("unknown-and-known", vec![own, ("mine", "walker2d", 0.5)]),
        ("unknown-and-alike", vec![("mine-a", "hopper", 0.5), ("mine-b", "walker2d", 0.5)]),
    ] {
        let run = |(task, environment, tau): (&str, &str, f64)| {
            let run = Run::new("hopper-demo", 0)
                .set("run.preset", task)
                .set("experiment.environment", environment)
                .set("dataset.mean_return", if environment == "hopper" { 20.0 } else { tau })
                .set("experiment.agent.tau", tau);
            complete(run, 40.0)
        };
        write_all(format!("named/{name}"), runs.into_iter().map(run));
    }
    let guided =
        |run: Run, guidance, score| complete(run.set("experiment.agent.guidance", guidance), score);
    let pairs = [("quad", 0, 10.0), ("quad", 1, 20.0), ("quad", 2, 30.0)].into_iter().chain([
        ("dac", 2, 31.0),
        ("dac", 1, 22.0),
        ("dac", 3, 5.0),
    ]);
    write_all(
        "pairs",
        pairs.map(|(guidance, seed, score)| guided(Run::new(TASKS[0], seed), guidance, score)),
    );
    // Two robots, one of them with two logs.
    let own = |environment, sha256: &str, guidance, score| {
        let run = Run::new("own-data", 0).set("experiment.environment", environment);
        guided(run.set("dataset.sha256", sha256.repeat(8)), guidance, score)
    };
    let logs = [
        own("reach", "12ab34cd", "quad", 1.0),
        own("reach", "12ab34cd", "dac", 2.0),
        own("reach", "56ef78ab", "quad", 3.0),
        own("push", "12ab34cd", "dac", 100.0),
    ];
    write_all("own", logs);
    let robot = Run::new(TASKS[0], 0)
        .set("experiment.environment", "my-robot")
        .set("run.preset", "my-robot");
    write_all(
        "robots",
        [
            guided(Run::new(TASKS[0], 0), "quad", 40.0),
            guided(robot.clone(), "quad", 900.0),
            guided(robot, "dac", 950.0),
        ],
    );
}

/// The runs of list.trycmd. The file is locked, as by a learner at work.
fn write_listed() -> File {
    let mut half = Run::new("hopper-demo", 3).sizes(40, 20, 2);
    half.score(20, 0, 5.0, "a");
    half.score(20, 1, 7.0, "a");
    half.score(40, 0, 9.0, "b");
    let mut whole = half.clone();
    whole.score(40, 1, 9.5, "b");
    whole.write("list/whole");
    half.write("list/study/half");
    half.write("list/damaged");
    fs::write("list/study/half/metrics.jsonl", "{\"step\":30,\"seconds\":1.5}\n").unwrap();
    fs::write("list/damaged/scores.jsonl", "{\"step\":10}\n").unwrap();
    fs::create_dir("list/other").unwrap();
    fs::write("list/other/config.toml", "[model]\nname = 'x'\n").unwrap();
    let scores = File::open("list/study/half/scores.jsonl").unwrap();
    scores.lock().unwrap();
    scores
}

/// The runs of verify.trycmd: a correct one, and others with one error each.
fn write_verified() {
    type Change = fn(&mut Vec<Value>);
    let changes: [(&str, Change); 11] = [
        ("whole", |_| ()),
        ("unscored", |lines| drop(lines.pop())),
        ("scored-twice", |lines| lines.push(lines[0].clone())),
        ("unknown-seed", |lines| lines.push(with(&lines[0], "seed", json!(1)))),
        ("other-weights", |lines| lines[2]["weights"] = lines[3]["weights"].clone()),
        ("no-snapshot", |lines| lines.push(with(&lines[0], "step", json!(12)))),
        ("other-return", |lines| lines[0]["return"] = json!(15f64.next_up())),
        ("two-scores", |lines| lines.truncate(2)),
        ("guessed-weights", |lines| lines[5]["weights"] = json!("00")),
        ("no-scores", |lines| lines.clear()),
        ("other-precision", |lines| lines[0]["precision"] = json!("bf16-amx")),
    ];
    for (name, change) in changes {
        let mut run = Run::new("hopper-demo", 4).sizes(15, 10, 3);
        for step in [10, 15] {
            for seed in episode_seeds(4, step, 3) {
                run.score(step, seed, 1.5, &Hash::new(&[step as u8; 100]).to_string());
            }
        }
        change(&mut run.scores);
        run.write(format!("verify/{name}"));
        for step in [10u8, 15] {
            let snapshot = format!("verify/{name}/snapshots/step_0000000{step}.safetensors");
            fs::write(snapshot, [step; 100]).unwrap();
        }
    }
    // As with `--eval-interval 0`: no evaluations, only snapshots.
    for name in ["alone", "alike", "flipped", "none", "judged", "judged-flipped"] {
        Run::new("hopper-demo", 4).sizes(15, 0, 3).write(format!("verify/{name}"));
        let mut snapshot = [7; 100];
        if name.starts_with("judged") {
            let weights = Hash::new(&snapshot).to_string();
            judge(&RunDir::at(Path::new("verify").join(name).as_path()), 15, 1.0, &weights);
        }
        snapshot[50] ^= u8::from(name.ends_with("flipped"));
        if name != "none" {
            let path = format!("verify/{name}/snapshots/step_000000015.safetensors");
            fs::write(path, snapshot).unwrap();
        }
    }
}

/// The runs of export-data.trycmd: one without experience, one with three episodes, in the first of
/// which a person acted twice.
fn write_online_runs() {
    let runs = ["online/none", "online/run"];
    for path in runs {
        Run::new("hopper-demo", 5).write(path);
    }
    let (mut log, _) = RunDir::at(Path::new(runs[1])).experience_log().unwrap();
    for (number, (length, terminated)) in
        [(30, true), (60, false), (20, true)].into_iter().enumerate()
    {
        let smooth = |count: usize, each: f32| {
            Vec::from_iter((0..count).map(|i| ((i + 40 * number) as f32 * each).sin()))
        };
        let seed = number as u64;
        let precision = Name::new("f32-avx512").unwrap();
        let episode = Episode {
            score: EpisodeScore { seed, episode_return: length as f64, length, score: 1.0 },
            terminated,
            observations: smooth((length as usize + 1) * 11, 0.37),
            actions: smooth(length as usize * 3, 1.3),
            rewards: smooth(length as usize, 0.1),
            interventions: if number == 0 { vec![3, 4] } else { Vec::new() },
            ..Episode::new(20_000, Hash::new(b"weights"), precision, seed)
        };
        log.append([&*encode(&episode).unwrap()]).unwrap();
    }
    // Another user's file, of an episode without observations.
    Run::new("hopper-demo", 5).write("online/foreign");
    let (mut log, _) = RunDir::at(Path::new("online/foreign")).experience_log().unwrap();
    let score = EpisodeScore { seed: 0, episode_return: 1.0, length: 1, score: 1.0 };
    let (actions, rewards) = (vec![0.5; 3], vec![1.0]);
    let precision = Name::new("f32").unwrap();
    let empty =
        Episode { score, actions, rewards, ..Episode::new(20, Hash::new(b""), precision, 0) };
    log.append([&*encode(&empty).unwrap()]).unwrap();
}

/// The runs of foreign.trycmd.
fn write_foreign() {
    let scored = |task: &str| {
        let mut run = Run::new("hopper-demo", 0).set("run.preset", task);
        run.score(1000, 0, 5.0, "00");
        run
    };
    scored("hopper-demo").write("foreign/linked");
    scored("../../outside/x").write("foreign/named");
    for (number, name) in ["../../outside/evil", "..", ""].into_iter().enumerate() {
        scored("hopper-demo").set("run.name", name).write(format!("foreign/renamed/{number}"));
    }
    for run in ["link", "text", "film"] {
        scored("hopper-demo").write(format!("foreign/{run}"));
    }
    fs::write("secret.gif", "GIF89a secret of the report's reader").unwrap();
    fs::write("foreign/text/film.gif", "a secret").unwrap();
    fs::copy("secret.gif", "foreign/film/film.gif").unwrap();
    symlink("../../secret.gif", "foreign/link/film.gif").unwrap();
    let mut huge = Run::new("hopper-demo", 0).sizes(1_000_000_000_000_000, 1, 1000);
    (0..1000).for_each(|seed| huge.score(1, seed, 5.0, "00"));
    huge.write("foreign/huge");
}

fn with(line: &Value, key: &str, value: Value) -> Value {
    let mut line = line.clone();
    line[key] = value;
    line
}
