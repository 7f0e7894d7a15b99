//! Tests of `report/remake.rs`.

use std::process;

use clap::Parser;
use quad_run::config::{Device, Experiment, Preset, resolve};
use quad_run::folder::RunDir;
use toml::toml;

use super::*;
use crate::cli::{Cli, Command};
use crate::fixtures::config;

/// The command for a run of this experiment.
fn command_for(experiment: Experiment) -> Option<String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("it's a run");
    RunDir::create(&path, &quad_run::config::RunConfig { experiment, ..config("r", 7) }).unwrap();
    command(&RunReport::read(&path).unwrap())
}

/// What a learner trains that a shell starts with it.
fn made_by(command: &str) -> Experiment {
    let words = process::Command::new("sh")
        .args(["-c", &format!("printf '%s\\n' {command}")])
        .output()
        .unwrap();
    let words = String::from_utf8(words.stdout).unwrap();
    let Command::Train(train) = Cli::try_parse_from(words.lines()).unwrap().command else {
        panic!("{command}")
    };
    assert!(train.run_dir.as_ref().is_some_and(|dir| dir.ends_with("it's a run")), "{command}");
    Preset::read(train.preset()).unwrap().resolve(&train.changes()).unwrap()
}

#[test]
fn a_shell_that_is_given_the_command_makes_the_same_run() {
    let nothing = toml::Table::new();
    for changes in [
        nothing.clone(),
        toml! { seed = 3 dataset = "a folder/$(it).hdf5" scale = ["actions"] batch_size = 64 },
        toml! { agent = { guidance = "dac", tau = 1.0, critic = { hidden = [512, 512], activation = "relu" } } },
        toml! { algorithm = "iql" steps = 5 precision = "bf16" },
    ] {
        let experiment = resolve("hopper-demo", &changes).unwrap();
        let command = command_for(experiment.clone()).unwrap();
        assert_eq!(made_by(&command), experiment, "{command}");
    }
    let plain =
        command_for(resolve("hopper-demo", &toml! { agent = { guidance = "dac" } }).unwrap())
            .unwrap();
    assert!(plain.contains(" --set agent.guidance=dac "), "{plain}");
}

#[test]
fn a_run_on_a_gpu_is_made_again_on_one() {
    let folder = tempfile::tempdir().unwrap();
    for (device, says) in [(Device::Cuda, true), (Device::Cpu, false)] {
        let mut config = config("r", 7);
        config.run.device = device;
        let path = folder.path().join(device.name());
        RunDir::create(&path, &config).unwrap();
        let command = command(&RunReport::read(&path).unwrap()).unwrap();
        assert_eq!(command.contains(" --device cuda "), says, "{command}");
    }
}

#[test]
fn a_run_that_lacks_a_value_of_its_task_has_no_command() {
    let mut experiment = resolve("hopper-demo", &toml::Table::new()).unwrap();
    experiment.agent.remove("rho").unwrap();
    assert_eq!(command_for(experiment), None);
}
