//! `learner train --dry-run`: what a run would be, and what it would take.

use toml::Table;

use crate::{learner, printed, write_dataset};

#[test]
fn a_dry_run_prints_the_run_and_its_cost_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let [data, run] =
        ["data.hdf5", "run"].map(|name| folder.path().join(name).display().to_string());
    write_dataset(data.as_ref());
    let changes = [
        "--seed",
        "7",
        "--set",
        "batch_size=8",
        "--set",
        "agent.actor.hidden=[8]",
        "--steps",
        "50",
    ];
    let asked =
        ["train", "--task", "hopper-demo", "--dataset", &data, "--run-dir", &run, "--dry-run"];
    let text = printed(&[&asked[..], &changes].concat());
    for words in [
        "# folder: ",
        "# data: 9",
        " ms a gradient step",
        "hours for all 50",
        "# memory: ",
        "# disk: ",
    ] {
        assert!(text.contains(words), "`{words}` is not in {text}");
    }
    // What is printed is a preset of one's own, which resolves to itself.
    let own = folder.path().join("own.toml");
    std::fs::write(&own, &text).unwrap();
    let printed: Table = printed(&["presets", own.to_str().unwrap()]).parse().unwrap();
    assert_eq!(printed, text.parse().unwrap());
    assert_eq!(
        (printed["seed"].as_integer(), printed["batch_size"].as_integer()),
        (Some(7), Some(8))
    );
    assert!(!std::path::Path::new(&run).exists());
}

/// Whatever an algorithm cannot learn with is refused while there is no folder to clear away.
#[test]
fn a_start_that_is_refused_leaves_no_folder() {
    let folder = tempfile::tempdir().unwrap();
    let [data, run] =
        ["data.hdf5", "run"].map(|name| folder.path().join(name).display().to_string());
    write_dataset(data.as_ref());
    let asked = [
        "train",
        "--task",
        "hopper-demo",
        "--dataset",
        &data,
        "--run-dir",
        &run,
        "--set",
        "batch_size=8",
    ];
    let too_large = ["--agent", "critics=1", "--agent", "actor.hidden=[4096,4096]"];
    for (changes, said) in [
        (&["--algorithm", "onestep", "--agent", "phases.policy=0"][..], "0 is not at least 1"),
        (&["--algorithm", "dtql", "--agent", "expectile=1"], "1 is not between 0 and 1"),
        (&["--agent", "diffusion_steps=1001"], "1001 is not a whole number from 1 to 1000"),
        (&too_large, "evaluators can be sent at most"),
    ] {
        let output = learner(&[&asked[..], changes].concat());
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(
            !output.status.success() && error.contains(said) && error.contains("hint: "),
            "{error}"
        );
        assert!(!std::path::Path::new(&run).exists(), "{changes:?}");
    }
}
