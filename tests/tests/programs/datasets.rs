//! Datasets by name, fetched from a mirror on this machine. The list and refusals are in
//! datasets.trycmd; how a file is fetched is tested beside the code that does it.

use std::fs;
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;

use quad_tests::process::{Process, assert_refused, binary, command, stdout};
use quad_tests::setting::SHORT;
use quad_tests::system::{Scratch, free_port};
use quad_tests::{PATIENCE, eventually, peers};

/// Serves a folder by HTTP; gives the address.
fn serve(scratch: &Scratch, python: &Path, folder: &Path) -> (Process, String) {
    let port = free_port();
    let mut serve = Command::new(python);
    serve.args(["-m", "http.server", "--bind", "127.0.0.1", &port.to_string()]).current_dir(folder);
    let server = Process::start("mirror", scratch.path(), serve);
    eventually("the mirror listens", PATIENCE, || TcpStream::connect(("127.0.0.1", port)).ok());
    (server, format!("http://127.0.0.1:{port}"))
}

fn assert_has_lines(config: &Path, lines: &[String]) {
    let config = fs::read_to_string(config).unwrap();
    for line in lines {
        assert!(config.lines().any(|found| found == line), "no {line} in:\n{config}");
    }
}

#[test]
fn a_run_by_name_fetches_its_dataset_once_and_records_its_checksum() {
    let scratch = Scratch::new();
    let Some(python) = peers::python(&["http.server"]) else { return };
    // A dataset of whose file only the name is known, so that any HDF5 file will do.
    let mirror = scratch.path().join("mirror");
    fs::create_dir(&mirror).unwrap();
    fs::copy(scratch.dataset(), mirror.join("hopper_random-v2.hdf5")).unwrap();
    let (server, url) = serve(&scratch, &python, &mirror);
    let requests = || server.log().matches("GET /").count();
    let cache = scratch.path().join("cache");
    // Port 9, which is closed, is the proxy for everything but this machine.
    let learner = |line: &str| {
        let mut learner = command(line);
        learner.env("D4RL_DATASET_DIR", &cache).env("QUAD_DATASETS_URL", &url);
        learner.env("ALL_PROXY", "http://127.0.0.1:9").env("NO_PROXY", "127.0.0.1");
        stdout(&learner.output().unwrap())
    };
    let preset = scratch.preset("tiny", SHORT);
    let file = cache.join("hopper_random-v2.hdf5");
    for run in ["first", "second"] {
        let run_dir = scratch.path().join(run);
        learner(&format!(
            "learner train --preset {} --run-dir {} --dataset hopper-random-v2 --eval-interval 0",
            preset.display(),
            run_dir.display()
        ));
        let sha256 = stdout(&Command::new("sha256sum").arg(&file).output().unwrap());
        let lines = [
            "dataset = \"hopper-random-v2\"".to_owned(),
            format!("path = {:?}", file.to_str().unwrap()),
            format!("sha256 = {:?}", sha256.split_whitespace().next().unwrap()),
        ];
        assert_has_lines(&run_dir.join("config.toml"), &lines);
        assert_eq!(requests(), 1, "the second run finds it in the cache");
    }
    let fetched = learner("learner datasets fetch hopper-random-v2");
    assert_eq!(fetched.trim_end(), file.to_str().unwrap());
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
    let (mirror, file) = (scratch.path().join("mirror"), "antmaze-medium-navigate-v0.npz");
    fs::create_dir(&mirror).unwrap();
    stdout(&Command::new(&python).args(["-c", STANDING]).arg(mirror.join(file)).output().unwrap());
    let (_server, url) = serve(&scratch, &python, &mirror);
    let run = scratch.path().join("run");
    let mut train = command(&format!(
        "learner train --task antmaze-medium-navigate-singletask-task2-v0 --algorithm iql \
         --evaluators 1 --listen tcp/127.0.0.1:{} --steps 20 --eval-interval 20 --episodes 2 \
         --set batch_size=32 --run-dir {}",
        free_port(),
        run.display()
    ));
    train.env("HOME", scratch.path()).env("QUAD_DATASETS_URL", url);
    stdout(&train.output().unwrap());
    let path = scratch.path().join(".ogbench/data").join(file);
    let lines = [
        "environment = \"antmaze-medium-singletask-task2-v0\"".to_owned(),
        format!("path = {:?}", path.to_str().unwrap()),
        "transitions = 114".to_owned(),
        "mean_score = 50.0".to_owned(), // three of six trajectories come to the goal
    ];
    assert_has_lines(&run.join("config.toml"), &lines);
    let scores = fs::read_to_string(run.join("scores.jsonl")).unwrap();
    assert_eq!(scores.matches("\"length\":1000").count(), 2, "{scores}");
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
    let locked = "log.hdf5: locked: another program has it open for writing";
    assert_refused(&inspect.output().unwrap(), locked, "");
    writer.unlock().unwrap();
    stdout(&inspect.output().unwrap());
}
