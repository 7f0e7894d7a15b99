//! Data that training must not touch, and places where nothing can be written: one sentence, a hint, exit code 1, and no
//! folder left behind. What can be wrong with a file is tested beside the reader.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use quad_tests::process::{assert_refused, binary};
use quad_tests::setting::SHORT;
use quad_tests::system::Scratch;

fn train(scratch: &Scratch, dataset: &Path, run_dir: &Path, flags: &[&str]) -> Output {
    let mut command = Command::new(binary("learner"));
    command.arg("train").arg("--preset").arg(scratch.preset("tiny", SHORT)).args(["--eval-interval", "0"]);
    command.arg("--dataset").arg(dataset).arg("--run-dir").arg(run_dir).args(flags).output().unwrap()
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
        (write("notes.hdf5", b"my notes"), &[][..], "notes.hdf5: neither an HDF5 file", "docs/data.md"),
        (write("half.hdf5", half), &[], "half.hdf5: cut short", "fetch or copy it again"),
        (walker, &[], "recorded in `walker2d`, which is not `hopper`", "choose a task in walker2d"),
        (scratch.dataset(), &["--set", "batch_size=5000"], "fewer than a batch of 5000", "batch_size"),
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
fn a_recording_that_cannot_be_replayed() {
    let verify = |path: &Path| Command::new(binary("evaluator")).arg("verify-dataset").arg(path).output().unwrap();
    let scratch = Scratch::new();
    hdf5::File::open_rw(scratch.dataset()).unwrap().unlink("infos").unwrap();
    assert_refused(&verify(&scratch.dataset()), "array `infos/qpos` is missing", "evaluator collect");
    let notes = scratch.path().join("notes.hdf5");
    fs::write(&notes, "my notes").unwrap();
    assert_refused(&verify(&notes), "neither an HDF5 file nor an npz archive", "docs/data.md");
}
