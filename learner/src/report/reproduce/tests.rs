//! Tests of `report/reproduce.rs`.

use std::process;

use clap::Parser;
use quad_run::config::{Device, Experiment, Preset, RunConfig, resolve};
use quad_run::folder::RunDir;
use toml::toml;

use super::*;
use crate::cli::{Cli, Command};
use crate::fixtures::config;

fn command_for(config: &RunConfig) -> Option<String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("it's a run");
    RunDir::create(&path, config).unwrap();
    command(&RunReport::read(&path).unwrap())
}

/// The experiment of the command as a shell parses it.
fn experiment_of(command: &str) -> Experiment {
    let print = format!("printf '%s\\n' {command}");
    let words = process::Command::new("sh").args(["-c", &print]).output().unwrap();
    let words = String::from_utf8(words.stdout).unwrap();
    let Command::Train(train) = Cli::try_parse_from(words.lines()).unwrap().command else {
        panic!("{command}")
    };
    assert!(train.run_dir.as_ref().is_some_and(|dir| dir.ends_with("it's a run")), "{command}");
    Preset::read(train.preset()).unwrap().resolve(&train.changes().unwrap()).unwrap()
}

#[test]
fn the_command_reproduces_the_experiment() {
    for (changes, words) in [
        (toml::Table::new(), ""),
        (
            toml! { seed = 3 dataset = "a folder/$(it).hdf5" normalize = ["actions"] batch_size = 64 },
            "",
        ),
        (
            toml! { agent = { guidance = "dac", tau = 1.0, critic = { hidden = [512, 512], activation = "relu" } } },
            " --set agent.guidance=dac ",
        ),
        (toml! { algorithm = "iql" steps = 5 precision = "bf16" }, ""),
    ] {
        let experiment = resolve("hopper-demo", &changes).unwrap();
        let run = RunConfig { experiment: experiment.clone(), ..config("r", 7) };
        let command = command_for(&run).unwrap();
        assert_eq!(experiment_of(&command), experiment, "{command}");
        assert!(command.contains(words) && !command.contains("--device"), "{command}");
    }
    let mut config = config("r", 7);
    let changes = toml! { environment = "hopper" dataset = "x.hdf5" hold_out = 0.0 };
    let mut own_data = config.clone();
    own_data.run.task = "own-data".to_owned();
    own_data.experiment = resolve("own-data", &changes).unwrap();
    let command = command_for(&own_data).unwrap();
    assert!(command.contains(" --hold-out 0 "), "{command}");
    assert_eq!(experiment_of(&command), own_data.experiment, "{command}");
    // This alpha is the preset's without online steps, with which it has another.
    let mut online = config.clone();
    online.run.task = "humanoidmaze-medium-navigate-singletask-v0".to_owned();
    let changes = toml! { algorithm = "fql" online.steps = 9 agent.alpha = 30.0 };
    online.experiment = resolve(&online.run.task, &changes).unwrap();
    let command = command_for(&online).unwrap();
    assert_eq!(experiment_of(&command), online.experiment, "{command}");
    let changes = toml! { from = "0123" online.steps = 5000 };
    let from = resolve("hopper-demo", &changes).unwrap();
    let command = command_for(&RunConfig { experiment: from, ..config.clone() }).unwrap();
    assert!(command.starts_with('#') && command.contains("0123: learner train --from RUN"));
    config.run.device = Device::Cuda;
    assert!(command_for(&config).unwrap().contains(" --device cuda "));
    config.experiment.agent.remove("rho").unwrap();
    assert_eq!(command_for(&config), None, "a value of the task is missing");
}
