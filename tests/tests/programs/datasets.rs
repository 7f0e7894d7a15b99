//! Datasets by name, as they are seen on a command line. How a file is fetched is tested beside the
//! code that does it.

use std::fs;
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Output};

use quad_tests::process::{Process, binary};
use quad_tests::setting::SHORT;
use quad_tests::system::{Scratch, free_port};
use quad_tests::{PATIENCE, eventually, peers};

/// Runs a learner whose cache folder is `cache`. Nothing but this machine can be reached: port 9,
/// which is closed, is the proxy for everything else.
fn learner(cache: &Path, mirror: &str, arguments: &[&str]) -> Output {
    let mut command = Command::new(binary("learner"));
    command.env("D4RL_DATASET_DIR", cache).env("QUAD_DATASETS_URL", mirror).args(arguments);
    command.env("ALL_PROXY", "http://127.0.0.1:9").env("NO_PROXY", "127.0.0.1").output().unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// What a command said that had to fail.
fn failure(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("error: ") && text.contains("\nhint: "), "{text}");
    text
}

#[test]
fn a_run_by_name_fetches_its_dataset_once_and_records_its_checksum() {
    let scratch = Scratch::new();
    let cache = scratch.path().join("cache");
    let Some(python) = peers::python(&["http.server"]) else { return };
    // A dataset of whose file only the name is known, so that any HDF5 file will do.
    let (folder, port) = (scratch.path().join("mirror"), free_port());
    fs::create_dir(&folder).unwrap();
    fs::copy(scratch.dataset(), folder.join("hopper_random-v2.hdf5")).unwrap();
    let mut serve = Command::new(python);
    serve.args(["-m", "http.server", "--bind", "127.0.0.1", &port.to_string()]).current_dir(folder);
    let server = Process::start("mirror", scratch.path(), serve);
    eventually("the mirror listens", PATIENCE, || TcpStream::connect(("127.0.0.1", port)).ok());
    let (url, requests) =
        (format!("http://127.0.0.1:{port}"), || server.log().matches("GET /").count());
    let preset = scratch.preset("tiny", SHORT);
    let file = cache.join("hopper_random-v2.hdf5");
    for run in ["first", "second"] {
        let run_dir = scratch.path().join(run);
        let paths = ["--preset", preset.to_str().unwrap(), "--run-dir", run_dir.to_str().unwrap()];
        let rest = ["--dataset", "hopper-random-v2", "--eval-interval", "0"];
        let output = learner(&cache, &url, &[&["train"], &paths[..], &rest].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let config = fs::read_to_string(run_dir.join("config.toml")).unwrap();
        let sha256 = stdout(&Command::new("sha256sum").arg(&file).output().unwrap());
        for line in [
            "dataset = \"hopper-random-v2\"".to_owned(),
            format!("path = {:?}", file.to_str().unwrap()),
            format!("sha256 = {:?}", sha256.split_whitespace().next().unwrap()),
        ] {
            assert!(config.lines().any(|found| found == line), "no {line} in:\n{config}");
        }
        assert_eq!(requests(), 1, "the second run finds it in the cache");
    }
    let fetched = learner(&cache, &url, &["datasets", "fetch", "hopper-random-v2"]);
    assert_eq!(stdout(&fetched).trim_end(), file.to_str().unwrap());
    assert_eq!(requests(), 1);
}

/// Writes a file as OGBench has it: an ant that stands at the goal of the second task in a medium
/// maze, or 2 m beside it.
const STANDING: &str = "
import sys, numpy
observations = numpy.zeros((120, 29), 'f4')
observations[:, :2] = [20, 0]
observations[60:, 1] = 2
observations[:, 2:4] = [0.75, 1]
actions, terminals = numpy.zeros((120, 8), 'f4'), numpy.arange(120) % 20 == 19
numpy.savez(sys.argv[1], observations=observations, actions=actions, terminals=terminals)
";

#[test]
fn a_task_of_ogbench_is_learned_by_its_name_and_evaluated_here() {
    let scratch = Scratch::new();
    let Some(python) = peers::python(&["numpy", "http.server"]) else { return };
    let (mirror, port) = (scratch.path().join("mirror"), free_port());
    fs::create_dir(&mirror).unwrap();
    let file = "antmaze-medium-navigate-v0.npz";
    let written =
        Command::new(&python).args(["-c", STANDING]).arg(mirror.join(file)).status().unwrap();
    assert!(written.success());
    let mut serve = Command::new(python);
    serve.args(["-m", "http.server", "--bind", "127.0.0.1", &port.to_string()]).current_dir(mirror);
    let _server = Process::start("mirror", scratch.path(), serve);
    eventually("the mirror listens", PATIENCE, || TcpStream::connect(("127.0.0.1", port)).ok());
    let run = scratch.path().join("run");
    let mut train = Command::new(binary("learner"));
    train.env("HOME", scratch.path()).env("QUAD_DATASETS_URL", format!("http://127.0.0.1:{port}"));
    train.args([
        "train",
        "--task",
        "antmaze-medium-navigate-singletask-task2-v0",
        "--algorithm",
        "iql",
        "--evaluators",
        "1",
    ]);
    train.args(["--listen", &format!("tcp/127.0.0.1:{}", free_port())]);
    train.args([
        "--steps",
        "20",
        "--eval-interval",
        "20",
        "--episodes",
        "2",
        "--set",
        "batch_size=32",
        "--run-dir",
    ]);
    let output = train.arg(&run).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let config = fs::read_to_string(run.join("config.toml")).unwrap();
    let path = scratch.path().join(".ogbench/data").join(file);
    for line in [
        "environment = \"antmaze-medium-singletask-task2-v0\"".to_owned(),
        format!("path = {:?}", path.to_str().unwrap()),
        "transitions = 114".to_owned(),
        "mean_score = 50.0".to_owned(), // three of six trajectories come to the goal
    ] {
        assert!(config.lines().any(|found| found == line), "no {line} in:\n{config}");
    }
    let scores = fs::read_to_string(run.join("scores.jsonl")).unwrap();
    assert_eq!(
        scores.lines().filter(|line| line.contains("\"length\":1000")).count(),
        2,
        "{scores}"
    );
}

#[test]
fn a_file_that_another_program_writes_is_not_called_damaged() {
    let scratch = Scratch::new();
    let path = scratch.path().join("log.hdf5");
    fs::copy(scratch.dataset(), &path).unwrap();
    let writer = fs::File::open(&path).unwrap();
    writer.lock().unwrap();
    let mut inspect = Command::new(binary("learner"));
    inspect.args(["datasets", "inspect"]).arg(&path).env_remove("HDF5_USE_FILE_LOCKING");
    let text = failure(&inspect.output().unwrap());
    assert!(text.contains("log.hdf5: locked: another program has it open for writing"), "{text}");
    writer.unlock().unwrap();
    assert!(inspect.output().unwrap().status.success());
}

#[test]
fn the_list_says_what_there_is_and_what_is_here() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("hopper_random-v2.hdf5"), "").unwrap();
    fs::write(folder.path().join("hopper_medium-v2.hdf5"), "half of it").unwrap();
    let output = learner(folder.path(), "", &["datasets", "list"]);
    assert!(output.status.success());
    let text = stdout(&output);
    for (name, state) in [
        ("hopper-random-v2 ", "  yes"),
        ("hopper-medium-v2 ", "  another file of 10 bytes"),
        ("antmaze-large-diverse-v0 ", "  no"),
    ] {
        assert!(
            text.lines().any(|line| line.starts_with(name) && line.ends_with(state)),
            "{name}:\n{text}"
        );
    }
    assert!(
        text.contains(&format!("\ncache folders: {}, and of OGBench ", folder.path().display())),
        "{text}"
    );
}

#[test]
fn what_makes_no_sense_is_refused_before_anything_is_fetched() {
    let folder = tempfile::tempdir().unwrap();
    let nowhere = "http://127.0.0.1:9";
    let train = |task, dataset| {
        learner(folder.path(), nowhere, &["train", "--task", task, "--dataset", dataset])
    };
    let fetch = |cache: &Path, dataset| learner(cache, nowhere, &["datasets", "fetch", dataset]);
    for (output, words) in [
        (train("hopper-demo", "hopper-medium-reply-v2"), "hopper-medium-replay-v2"),
        (
            train("hopper-demo", "walker2d-medium-v2"),
            "is a dataset of walker2d, but the policy is for hopper",
        ),
        (
            train("hopper-demo", "data/halfcheetah_medium-v2.hdf5"),
            "halfcheetah-medium-v2 is a dataset of halfcheetah",
        ),
        (train("hopper-demo", "minari:none/has-this-v0"), "minari download none/has-this-v0"),
        (fetch(folder.path(), "hoper-medium-v2"), "hopper-medium-v2"),
        (fetch(Path::new("/proc/version/cache"), "hopper-random-v2"), "/proc/version/cache"),
    ] {
        let text = failure(&output);
        assert!(text.contains(words), "{text}");
    }
}
