//! Recorded datasets: a function of the seed, and a faithful replay.

use std::ffi::OsStr;
use std::fs;
use std::path::Path;

use candle_core::{Device, Tensor};
use clap::FromArgMatches;
use quad_dataset::RecordedRows;
use quad_nn::Layout;
use quad_policy::{Header, MlpConfig, PolicyConfig};
use quad_protocol::{Hash, Origin};
use serde_json::json;

use super::policies::Behavior;
use super::*;
use crate::tools::verify::{environment_of, verify};

const TRANSITIONS: usize = 2000;

fn hopper() -> &'static EnvironmentSpec {
    find("hopper").unwrap()
}

/// The arguments that record in Hopper, with `options`.
fn arguments(out: &Path, options: &str) -> CollectArgs {
    let line = format!("collect --env hopper --transitions {TRANSITIONS} {options} --out");
    let words = line.split_whitespace().map(OsStr::new).chain([out.as_os_str()]);
    let command = CollectArgs::augment_args(clap::Command::new("collect"));
    CollectArgs::from_arg_matches(&command.try_get_matches_from(words).unwrap()).unwrap()
}

/// Records on that many threads.
fn collect_on(threads: usize, args: &CollectArgs) -> Summary {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    pool.unwrap().install(|| collect(args)).unwrap()
}

fn read(path: &Path) -> RecordedRows {
    RecordedRows::read(path, hopper()).unwrap()
}

#[test]
fn the_file_depends_on_the_seed_and_not_on_the_threads() {
    let folder = tempfile::tempdir().unwrap();
    let [out, path] = ["data.hdf5", "policy.safetensors"].map(|name| folder.path().join(name));
    fs::write(&path, policy()).unwrap();
    for options in [String::new(), format!("--policy random --policy {}", path.display())] {
        let file = |seed, threads| {
            collect_on(threads, &arguments(&out, &format!("{options} --seed {seed}")));
            fs::read(&out).unwrap()
        };
        let two = file(1, 2);
        assert!(file(1, 1) == two);
        assert!(file(2, 2) != two);
    }
}

/// A squashed Gaussian policy whose mode is tanh(0.3) and whose log σ is 0.3 in all states.
fn policy() -> Vec<u8> {
    let shape = json!({
        "observation_dim": 11,
        "action_dim": 3,
        "actor": MlpConfig::mish(&[1]),
        "spread": "squashed",
    });
    let policy = json!({ "kind": "gaussian", "shape": shape });
    let policy: PolicyConfig = serde_json::from_value(policy).unwrap();
    // Kernels and biases of one hidden unit, then kernels and biases of the outputs.
    let values = |layout: &Layout| {
        let mut values = vec![0.0_f32; layout.count()];
        values[18..].fill(0.3);
        Tensor::new(values, &Device::Cpu)
    };
    let tensors = policy.tensors(values).unwrap();
    let origin = Origin { environment: "hopper".to_owned(), seed: 1, step: 40, episodes: 2 };
    let about = json!({ "run": "mine", "algorithm": "sac" });
    Header { about, ..Header::new(policy, origin) }.to_safetensors(&tensors).unwrap()
}

#[test]
fn actions_are_drawn_or_the_mode_with_noise_or_uniform_and_the_file_names_the_policy() {
    let folder = tempfile::tempdir().unwrap();
    let [out, path] = ["data.hdf5", "policy.safetensors"].map(|name| folder.path().join(name));
    fs::write(&path, policy()).unwrap();
    let weights = Hash::new(&policy()).to_string();
    let tanh = 0.3_f64.tanh();
    for (options, mean, std, algorithm) in [
        // Mean and standard deviation of tanh(u), u ~ N(0.3, e^0.3), by quadrature.
        ("--policy FILE", 0.148, 0.700, "sac, sampled, noise 0"),
        ("--policy FILE --mode", tanh, 0.0, "sac, mode, noise 0"),
        ("--policy FILE --mode --noise 0.1", tanh, 0.1, "sac, mode, noise 0.1"),
        ("--policy random", 0.0, 0.577, "uniform"),
        ("--policy random --policy FILE --mode", tanh, 0.0, "uniform; sac, mode, noise 0"),
    ] {
        let args = arguments(&out, &options.replace("FILE", path.to_str().unwrap()));
        let mut writer = D4rlWriter::create(&out, hopper()).unwrap();
        let behaviors = args.policy.iter().map(|path| Behavior::read(path, &args).unwrap());
        let recorded = policies::record(&Vec::from_iter(behaviors), &args, &mut writer).unwrap();
        writer.finish(&Metadata::default()).unwrap();
        assert_eq!(recorded.algorithm, algorithm);
        let origin = (recorded.run.as_deref(), recorded.weights.as_ref(), recorded.iteration);
        let named = (Some("mine"), Some(&weights), 40);
        assert_eq!(origin, if algorithm == "uniform" { (None, None, 0) } else { named });
        let rows = read(&out);
        let is_mode = rows.row(0).action.iter().all(|x| (x - tanh).abs() < 1e-6);
        assert_eq!(is_mode, options.ends_with("FILE --mode") && !options.contains("random"));
        // The second of two policies acts in the second half, but for the end of an episode.
        let half = rows.iter().skip(TRANSITIONS / 2 + 200);
        let actions = Vec::from_iter(half.flat_map(|row| row.action.to_vec()));
        let spread = Spread::new(&actions).unwrap();
        let error = (spread.mean - mean).abs().max((spread.population_std.unwrap() - std).abs());
        assert!(error < 0.05 && (std > 0.0 || error < 1e-6), "{algorithm}: {spread:?}");
    }
}

#[test]
fn whole_episodes_are_recorded_and_replay_and_changes_are_noticed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("data.hdf5");
    let summary = collect_on(2, &arguments(&path, "--seed 3"));
    let (transitions, episodes) = (summary.transitions, summary.episodes);
    let rows = read(&path);
    assert!(rows.len() == transitions && transitions >= TRANSITIONS);
    let (mut returns, mut episode_return) = (Vec::new(), 0.0);
    for i in 0..transitions {
        let row = rows.row(i);
        assert!(row.action.iter().all(|value| value.abs() <= 1.0));
        episode_return += row.reward;
        let is_end = row.terminal || row.timeout;
        if is_end {
            returns.push(std::mem::take(&mut episode_return));
        }
        let is_followed =
            i + 1 < transitions && rows.row(i + 1).observation == row.next_observation;
        assert_eq!(is_followed, !is_end, "row {i}");
    }
    assert_eq!(returns.len(), episodes);
    let mean = returns.iter().sum::<f64>() / episodes as f64;
    let best = returns.into_iter().fold(f64::NEG_INFINITY, f64::max);
    let percentiles = summary.score_percentiles;
    assert!(percentiles.is_sorted(), "{percentiles:?}");
    for (score, episode_return) in [(summary.score.mean, mean), (percentiles[3], best)] {
        assert!((score - hopper().normalized_score(episode_return)).abs() < 1e-3, "{score}");
    }

    assert_eq!(environment_of(&path).unwrap(), hopper());
    let report = verify(&path, hopper()).unwrap();
    assert_eq!([report.transitions, report.compared], [transitions; 2]);
    assert_eq!((report.rewards_differ, report.terminals_differ), (0, 0));
    // Float32's rounding; an error of exactly zero would mean that nothing was compared.
    let errors = &report.obs_error;
    assert!((1e-9..1e-6).contains(&errors.median), "{report:?}");
    assert!(errors.p99 < 1e-5, "{report:?}");
    assert!(report.reward_error.max < 1e-3, "{report:?}");

    let changed = folder.path().join("changed.hdf5");
    let mut writer = D4rlWriter::create(&changed, hopper()).unwrap();
    for (i, mut row) in rows.iter().enumerate() {
        let mut next_observation = row.next_observation.to_vec();
        match i {
            10 => row.reward += 0.01,
            20 => row.terminal = !row.terminal,
            30 => next_observation[4] += 0.5,
            _ => {}
        }
        row.next_observation = &next_observation;
        writer.push(&row).unwrap();
    }
    writer.finish(&Metadata::default()).unwrap();
    let report = verify(&changed, hopper()).unwrap();
    assert_eq!((report.rewards_differ, report.terminals_differ), (1, 1));
    for (error, expected) in [(report.reward_error.max, 0.01), (report.obs_error.max, 0.5)] {
        assert!((error - expected).abs() < 1e-4, "{report:?}");
    }
}
