//! Data that training must not touch, and places where nothing can be written: one sentence, a
//! hint, exit code 1, and no folder left behind. What can be wrong with a file is tested beside the
//! reader.

use std::fs::{self, Permissions};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use quad_tests::PATIENCE;
use quad_tests::process::{assert_refused, binary};
use quad_tests::setting::SHORT;
use quad_tests::system::Scratch;

fn train(scratch: &Scratch, dataset: &Path, run_dir: &Path, flags: &[&str]) -> Output {
    let mut command = Command::new(binary("learner"));
    command
        .arg("train")
        .arg("--preset")
        .arg(scratch.preset("tiny", SHORT))
        .args(["--eval-interval", "0"]);
    command
        .arg("--dataset")
        .arg(dataset)
        .arg("--run-dir")
        .arg(run_dir)
        .args(flags)
        .output()
        .unwrap()
}

#[test]
fn a_dataset_that_cannot_be_trained_on() {
    let scratch = Scratch::new();
    let write = |name: &str, bytes: &[u8]| {
        fs::write(scratch.path().join(name), bytes).unwrap();
        scratch.path().join(name)
    };
    let whole = fs::read(scratch.dataset()).unwrap();
    let half = &whole[..whole.len() / 2];
    let walker = scratch.path().join("walker.hdf5");
    let mut collect = Command::new(binary("evaluator"));
    collect.args(["collect", "--env", "walker2d", "--transitions", "500", "--out"]).arg(&walker);
    assert!(collect.output().unwrap().status.success());
    let run_dir = scratch.path().join("run");
    for (dataset, flags, sentence, hint) in [
        (
            write("notes.hdf5", b"my notes"),
            &[][..],
            "notes.hdf5: neither an HDF5 file",
            "docs/data.md",
        ),
        (write("half.hdf5", half), &[], "half.hdf5: cut short", "fetch or copy it again"),
        (walker, &[], "recorded in `walker2d`, which is not `hopper`", "choose a task in walker2d"),
        (
            scratch.dataset(),
            &["--set", "batch_size=5000"],
            "fewer than a batch of 5000",
            "batch_size",
        ),
    ] {
        let output = train(&scratch, &dataset, &run_dir, flags);
        assert_refused(&output, sentence, hint);
        assert!(!run_dir.exists(), "{sentence}: a refused start leaves a folder behind");
    }
}

#[test]
fn a_run_folder_that_cannot_be_made() {
    let scratch = Scratch::new();
    let file = scratch.path().join("file");
    fs::write(&file, "in the way").unwrap();
    // Also for root, who may write anywhere else.
    for run_dir in [file.join("run"), PathBuf::from("/proc/run")] {
        let output = train(&scratch, &scratch.dataset(), &run_dir, &[]);
        assert_refused(&output, run_dir.to_str().unwrap(), "--run-dir");
    }
}

#[test]
fn a_port_that_is_taken() {
    let scratch = Scratch::new();
    let run_dir = scratch.path().join("run");
    let taken = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let _taken = TcpListener::bind(taken).unwrap();
    let output = train(&scratch, &scratch.dataset(), &run_dir, &["--http", &taken.to_string()]);
    assert_refused(&output, &format!("cannot listen at {taken}"), "port 0");
    assert!(!run_dir.exists());
}

#[test]
fn an_evaluator_that_cannot_start_says_why() {
    let scratch = Scratch::new();
    let programs = scratch.path().join("programs");
    fs::create_dir(&programs).unwrap();
    fs::copy(binary("learner"), programs.join("learner")).unwrap();
    let evaluator = programs.join("evaluator");
    fs::write(
        &evaluator,
        "#!/bin/sh\necho libmujoco.so: cannot open shared object file >&2; exit 127\n",
    )
    .unwrap();
    fs::set_permissions(&evaluator, Permissions::from_mode(0o755)).unwrap();
    let mut command = Command::new(programs.join("learner"));
    command
        .args(["train", "--task", "hopper-demo", "--evaluators", "1", "--dataset"])
        .arg(scratch.dataset());
    assert_refused(&command.output().unwrap(), "libmujoco.so: cannot open", "deploy/setup.sh");
}

#[test]
fn files_that_are_no_runs_or_presets_and_places_that_cannot_be_written() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner_with("good", SHORT, &["--eval-interval", "0"]);
    learner.process.assert_succeeds(PATIENCE);
    let path = |name: &str| scratch.path().join(name).to_str().unwrap().to_owned();
    fs::create_dir(path("run")).unwrap();
    fs::write(path("run/config.toml"), "name = 'x'\nlist = [\n").unwrap();
    fs::write(path("mine.toml"), "list = [\n").unwrap();
    let wrong =
        format!("error: {}, line 2, is not what a learner writes: ", path("run/config.toml"));
    for (command, sentence, hint) in [
        (format!("learner report {}", path("run")), &*wrong, "put a copy"),
        (
            format!("learner report {}", path("mine.toml")),
            "cannot read",
            "that `learner train` has written",
        ),
        (
            format!("learner presets {}", path("mine.toml")),
            "mine.toml is not TOML",
            "`learner presets TASK`",
        ),
        (
            format!("learner presets {}", path("missing.toml")),
            "missing.toml",
            "`learner presets TASK`",
        ),
        (format!("learner report {} --figures /proc/x", path("good")), "/proc/x", "--figures"),
        (format!("evaluator film {} --out /proc/x.gif", path("good")), "/proc/x.gif", "--out"),
        (format!("evaluator collect --env hopper --out {}", path("")), "is a directory", "--out"),
    ] {
        let words: Vec<&str> = command.split(' ').collect();
        let output = Command::new(binary(words[0])).args(&words[1..]).output().unwrap();
        assert_refused(&output, sentence, hint);
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(!text.contains("\n\n") && !text.contains("search 1 of"), "{command}: {text}");
    }
}

#[test]
fn a_recording_that_is_replayed_differently_or_not_at_all() {
    let verify = |path: &Path| {
        Command::new(binary("evaluator")).arg("verify-dataset").arg(path).output().unwrap()
    };
    let scratch = Scratch::new();
    let made_up = verify(&scratch.dataset());
    assert_eq!(made_up.status.code(), Some(1));
    assert!(
        String::from_utf8_lossy(&made_up.stdout).contains("terminals differ   2990"),
        "{made_up:?}"
    );
    hdf5::File::open_rw(scratch.dataset()).unwrap().unlink("infos").unwrap();
    assert_refused(
        &verify(&scratch.dataset()),
        "array `infos/qpos` is missing",
        "evaluator collect",
    );
    let notes = scratch.path().join("notes.hdf5");
    fs::write(&notes, "my notes").unwrap();
    assert_refused(&verify(&notes), "neither an HDF5 file nor an npz archive", "docs/data.md");
}
