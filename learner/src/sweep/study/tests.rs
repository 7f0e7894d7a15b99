//! Tests of the room `sweep`: study files.

use super::*;

/// A file with these axes and rules, read.
fn read(rest: &str) -> anyhow::Result<Study> {
    read_as(rest, &[], &[])
}

/// A file with these axes and rules, read with these flags.
fn read_as(rest: &str, only: &[&str], set: &[&str]) -> anyhow::Result<Study> {
    let [only, set] = [only, set].map(|words| {
        Vec::from_iter(words.iter().map(|word| tables::parse_assignment(word).unwrap()))
    });
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.toml");
    let text = "about = 'a question'\nrun = { dataset = 'x.hdf5', steps = 7 }\n";
    std::fs::write(&path, text.to_owned() + rest).unwrap();
    Study::read(&path, &only, &set)
}

fn names(rest: &str) -> Vec<String> {
    read(rest).unwrap().runs.into_iter().map(|run| run.name).collect()
}

const METHODS: &str = "[method.none]\nagent.guidance = 'none'\n[method.iql]\nalgorithm = 'iql'\n[method.dac]\n\"agent.guidance\" = 'dac'\n";

#[test]
fn every_combination_is_a_run_and_seeds_change_last() {
    let study = read(&format!(
        "axes = {{ seed = [0, 3], task = ['hopper-demo'], method = ['none', 'iql'] }}\n{METHODS}"
    ))
    .unwrap();
    let names: Vec<_> = study.runs.iter().map(|run| (run.index, &*run.name)).collect();
    let expected = [
        "hopper-demo-none-seed0",
        "hopper-demo-iql-seed0",
        "hopper-demo-none-seed3",
        "hopper-demo-iql-seed3",
    ];
    assert_eq!(names, Vec::from_iter(expected.into_iter().enumerate()));
    let last = &study.runs[3].experiment;
    assert_eq!((&*last.algorithm, last.seed, last.steps), ("iql", 3, 7));
    assert_eq!(study.runs[2].experiment.agent["guidance"].as_str(), Some("none"));
}

#[test]
fn a_run_is_what_its_command_line_would_be() {
    let study = read(
        "[axes]\ntask = ['hopper-demo']\nagent.tau = [0.1, 2]\nagent.critic.hidden = [[8, 8]]\nprecision = ['bf16']\n",
    )
    .unwrap();
    let run = &study.runs[1];
    assert_eq!(run.name, "hopper-demo-hidden8-8-tau2-precision-bf16");
    let words = tables::keys(&run.changes).into_iter().map(|(key, value)| format!("{key}={value}"));
    let mut changes = Table::new();
    words.for_each(|word| tables::merge(&mut changes, tables::parse_assignment(&word).unwrap()));
    assert_eq!(quad_run::config::resolve(&run.preset, &changes).unwrap(), run.experiment);
    let two =
        "[axes]\ntask = ['hopper-demo']\nagent.actor.hidden = [[8]]\nagent.critic.hidden = [[9]]\n";
    assert_eq!(names(two), ["hopper-demo-agent.actor.hidden8-agent.critic.hidden9"]);
}

#[test]
fn rules_choose_combinations() {
    let axes = "[axes]\ntask = ['hopper-demo', 'walker2d-demo']\nmethod = ['none', 'dac']\nagent.tau = [0.5, 1.0]\n";
    let with = |rules: &str| names(&format!("{axes}{METHODS}{rules}"));
    assert_eq!(with("").len(), 8);
    let except = with("[[except]]\nmethod = 'none'\nagent.tau = 1\n[[except]]\ntask = 'walker*'\n");
    assert_eq!(
        except,
        ["hopper-demo-none-tau0.5", "hopper-demo-dac-tau0.5", "hopper-demo-dac-tau1.0"]
    );
    let only = with(
        "[[only]]\ntask = 'w*-demo'\nmethod = ['dac', 'none']\nagent.tau = 0.5\n[[only]]\ntask = 'hopper-demo'\nagent.tau = 1\n",
    );
    assert_eq!(only.len(), 4);
}

#[test]
fn all_that_is_wrong_is_told_at_once() {
    let refused = |rest: &str, words: &[&str]| {
        let error = read(rest).unwrap_err();
        let text = format!("{error:#} {}", hints(&error).collect::<String>());
        words.iter().for_each(|word| assert!(text.contains(word), "`{word}` is not in {text}"));
    };
    let task = "task = ['hopper-demo']";
    refused(
        "axes = { seed = [], agent.tau = [1, 1], steps = 3 }",
        &["seed has no values", "tau has the value 1 twice", "steps = [3]"],
    );
    refused("axes = {}", &["no axis"]);
    refused("axes = { seed = [0] }", &["seed0: it needs one of task and preset"]);
    refused("axis = { seed = [0] }", &["unknown field `axis`"]);
    refused(
        &format!("axes = {{ {task}, seed = [-1], agent.tua = [2] }}"),
        &["hopper-demo-tua2-seed-1: "],
    );
    refused(
        "axes = { task = ['hoper-demo', 'own-data'], seed = [0] }",
        &["hoper-demo-seed0: there is no task", "did you mean hopper-demo"],
    );
    refused(
        &format!("axes = {{ {task}, method = ['nine'] }}\n{METHODS}"),
        &["no table [method.nine]", "did you mean none"],
    );
    refused(
        &format!("axes = {{ {task}, steps = [5] }}"),
        &["steps is an axis, and [run] has it, too"],
    );
    refused(
        &format!("axes = {{ {task}, dataset = ['a/b.hdf5', 'c/b.npz'] }}"),
        &["dataset is an axis"],
    );
    refused(
        &format!(
            "axes = {{ {task}, normalize = [['observations'], ['observations', 'actions', 'observations']], agent.actor.hidden = [[{}]] }}",
            "1000, ".repeat(20)
        ),
        &["1 to 64", "axis `method`"],
    );
    let rules = format!("[axes]\n{task}\nseed = [1]\n[[only]]\nsede = 1\n[[except]]\nseed = 2\n");
    refused(&rules, &["names sede, which is no axis", "[[except]] fits no combination: seed = 2"]);
    refused(&format!("[axes]\n{task}\n[[except]]\ntask = '*'\n"), &["the rules leave no run"]);
    refused(
        &format!("axes = {{ {task}, agent.nu_ema_rate = [0.5, '0.5'] }}"),
        &["hopper-demo-nu_ema_rate-0.5"],
    );
}

#[test]
fn the_command_line_keeps_to_some_runs_and_changes_all_of_them() {
    let axes = format!(
        "[axes]\ntask = ['hopper-demo', 'walker2d-demo']\nmethod = ['none', 'iql']\nseed = [0, 1]\n{METHODS}"
    );
    let study =
        read_as(&axes, &["task=hopper-*", "seed=1", "seed=2"], &["steps=9", "agent.gamma=0.5"])
            .unwrap();
    let runs = study.runs.iter().map(|run| (run.index, &*run.name, run.experiment.steps));
    let runs = Vec::from_iter(runs);
    assert_eq!(runs, [(4, "hopper-demo-none-seed1", 9), (5, "hopper-demo-iql-seed1", 9)]);
    assert_eq!(study.runs[1].experiment.agent["gamma"].as_float(), Some(0.5));
    let error = read_as(&axes, &["sede=1"], &["seed=3"]).unwrap_err().to_string();
    assert!(error.contains("--only names sede, which is no axis"), "{error}");
    let error = read_as(&axes, &[], &["seed=3"]).unwrap_err().to_string();
    assert!(error.contains("seed is an axis, and --set has it, too"), "{error}");
}

#[test]
fn a_run_of_other_data_is_never_taken_for_one_of_the_study() {
    let study = read("axes = { task = ['hopper-demo'], seed = [0] }").unwrap();
    let folder = tempfile::tempdir().unwrap();
    for (dataset, is_its) in [("x.hdf5", true), ("y.hdf5", false)] {
        let path = folder.path().join(dataset);
        let mut config = crate::fixtures::config("run", 0);
        config.experiment =
            Experiment { dataset: Some(dataset.to_owned()), ..study.runs[0].experiment.clone() };
        RunDir::create(&path, &config).unwrap();
        match study.runs[0].state(&path) {
            Ok(state) => assert_eq!((state, is_its), (State::Begun(0), true)),
            Err(error) => assert!(
                !is_its && error.to_string().ends_with("than the study's: dataset"),
                "{error}"
            ),
        }
    }
}

/// How many runs studies have: Table 1 without two methods in mazes, Table 2's two on seven tasks,
/// five values of τ, and what is compared today: seven methods with eight seeds in six mazes and
/// with five tables of an arm.
#[test]
fn studies_are_what_papers_train() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../studies");
    for (name, runs) in [
        ("table1", (15 * 12 - 6 * 2) * 4),
        ("table2", 7 * 2 * 4),
        ("tau", 15 * 5 * 4),
        ("today", 6 * 7 * 8),
        ("today-arm", 5 * 7 * 8),
    ] {
        let study = Study::read(&folder.join(name).with_extension("toml"), &[], &[]).unwrap();
        assert_eq!(study.runs.len(), runs, "{name}");
        // Each begins from the paper's own settings of its task.
        assert!(study.runs.iter().all(|run| run.experiment.steps >= 100_000), "{name}");
    }
}

#[test]
fn the_example_of_the_documentation_is_a_study() {
    let page = include_str!("../../../../studies/README.md");
    let (_, example) = page.split_once("```toml\n").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("example.toml");
    std::fs::write(&path, example.split_once("```").unwrap().0).unwrap();
    // Of 3 tasks, 2 methods, 2 values of τ and 3 seeds, without dac in the maze, and with one τ for
    // dac.
    assert_eq!(Study::read(&path, &[], &[]).unwrap().runs.len(), (2 * (1 + 2) + 2) * 3);
}
