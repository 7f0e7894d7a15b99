//! Tests of study files.

use quad_runtime::hints;

use super::*;

const HEAD: &str = "about = 'a question'\nrun = { dataset = 'x.hdf5', steps = 7 }\n";
const METHODS: &str = "[method.none]\nagent.guidance = 'none'\n[method.iql]\nalgorithm = 'iql'\n[method.dac]\n\"agent.guidance\" = 'dac'\n";

fn read(rest: &str) -> anyhow::Result<Study> {
    read_with(rest, &[], &[])
}

/// Reads a file with these axes and rules, and these values of --only and --set.
fn read_with(rest: &str, only: &[&str], set: &[&str]) -> anyhow::Result<Study> {
    let parse = |word: &&str| tables::parse_assignment(word).unwrap();
    let [only, set] = [only, set].map(|words| Vec::from_iter(words.iter().map(parse)));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.toml");
    std::fs::write(&path, HEAD.to_owned() + rest).unwrap();
    Study::read(&path, &only, &set)
}

/// Number and name of each run, as `--list` prints them.
fn listed(study: &Study) -> String {
    let runs = study.runs.iter();
    Vec::from_iter(runs.map(|run| format!("{} {}", run.index, run.name))).join(", ")
}

#[test]
fn every_combination_is_a_run_and_seeds_change_last() {
    let axes = "axes = { seed = [0, 3], task = ['hopper-demo'], method = ['none', 'iql'] }\n";
    let study = read(&format!("{axes}{METHODS}")).unwrap();
    assert_eq!(
        listed(&study),
        "0 hopper-demo-none-seed0, 1 hopper-demo-iql-seed0, 2 hopper-demo-none-seed3, 3 hopper-demo-iql-seed3"
    );
    let last = &study.runs[3].experiment;
    assert_eq!((&*last.algorithm, last.seed, last.steps), ("iql", 3, 7));
    assert_eq!(study.runs[2].experiment.agent["guidance"].as_str(), Some("none"));
}

#[test]
fn changes_as_flags_give_the_same_experiment() {
    let axes = "[axes]\ntask = ['hopper-demo']\nagent.tau = [0.1, 2]\nagent.critic.hidden = [[8, 8]]\nprecision = ['bf16']\n";
    let run = read(axes).unwrap().runs.remove(1);
    assert_eq!(run.name, "hopper-demo-hidden8-8-tau2-precision-bf16");
    let mut changes = Table::new();
    for (key, value) in tables::keys(&run.changes) {
        let flag = format!("{key}={value}");
        tables::merge(&mut changes, tables::parse_assignment(&flag).unwrap());
    }
    assert_eq!(quad_run::config::resolve(&run.preset, &changes).unwrap(), run.experiment);
    let axes =
        "[axes]\ntask = ['hopper-demo']\nagent.actor.hidden = [[8]]\nagent.critic.hidden = [[9]]\n";
    let study = read(axes).unwrap();
    assert_eq!(listed(&study), "0 hopper-demo-agent.actor.hidden8-agent.critic.hidden9");
}

#[test]
fn rules_select_combinations() {
    let axes = "[axes]\ntask = ['hopper-demo', 'walker2d-demo']\nmethod = ['none', 'dac']\nagent.tau = [0.5, 1.0]\n";
    let with = |rules: &str| read(&format!("{axes}{METHODS}{rules}")).unwrap();
    assert_eq!(with("").runs.len(), 8);
    let except = "[[except]]\nmethod = 'none'\nagent.tau = 1\n[[except]]\ntask = 'walker*'\n";
    assert_eq!(
        listed(&with(except)),
        "0 hopper-demo-none-tau0.5, 1 hopper-demo-dac-tau0.5, 2 hopper-demo-dac-tau1.0"
    );
    let only = "[[only]]\ntask = 'w*-demo'\nmethod = ['dac', 'none']\nagent.tau = 0.5\n[[only]]\ntask = 'hopper-demo'\nagent.tau = 1\n";
    assert_eq!(with(only).runs.len(), 4);
}

/// Tables and the words, separated by `|`, of the error that they cause.
const PROBLEMS: &str = "
axes = { seed = [], agent.tau = [1, 1], steps = 3 } -> seed has no values|tau has the value 1 twice|steps = [3]
axes = {} -> no axis
axes = { seed = [0] } -> seed0: it needs one of task and preset
axis = { seed = [0] } -> unknown field `axis`
axes = { TASK, seed = [-1], agent.tua = [2] } -> hopper-demo-tua2-seed-1: |
axes = { TASK, agent.tua = [2], seed = [0, 1, 2, 3] } -> tua2-seed2 and 1 other: algorithm quad
axes = { task = ['hoper-demo', 'own-data'] } -> hoper-demo: there is no task|did you mean hopper-demo
axes = { TASK, method = ['nine'] } -> no table [method.nine]|did you mean none
axes = { TASK, steps = [5] } -> steps is an axis, and [run] has it, too
axes = { TASK, dataset = ['a/b.hdf5', 'c/b.npz'] } -> dataset is an axis
axes = { TASK, normalize = [['observations']], agent.actor.hidden = [[LONG]] } -> 1 to 64|axis `method`
axes = { TASK, seed = [1] }; only = [{ sede = 1 }] -> names sede, which is no axis
axes = { TASK, seed = [1] }; except = [{ seed = 2 }] -> [[except]] fits no combination: seed = 2
axes = { TASK }; except = [{ task = '*' }] -> the rules leave no run
axes = { TASK, agent.nu_ema_rate = [0.5, '0.5'] } -> hopper-demo-nu_ema_rate-0.5";

#[test]
fn problems_are_reported_together() {
    for problem in PROBLEMS.trim().lines() {
        let (tables, words) = problem.split_once(" -> ").unwrap();
        let tables = tables.replace("; ", "\n").replace("LONG", &"1000, ".repeat(20));
        let tables = tables.replace("TASK", "task = ['hopper-demo']");
        let error = read(&format!("{tables}\n{METHODS}")).unwrap_err();
        let text = format!("{error:#} {}", hints(&error).collect::<String>());
        for words in words.split('|') {
            assert!(text.contains(words), "`{words}` is not in {text}");
        }
    }
}

#[test]
fn the_command_line_selects_and_changes_runs() {
    let axes = "[axes]\ntask = ['hopper-demo', 'walker2d-demo']\nmethod = ['none', 'iql']\nseed = [0, 1]\n";
    let axes = format!("{axes}{METHODS}");
    let only = ["task=hopper-*", "seed=1", "seed=2"];
    let study = read_with(&axes, &only, &["steps=9", "agent.gamma=0.5"]).unwrap();
    assert_eq!(listed(&study), "4 hopper-demo-none-seed1, 5 hopper-demo-iql-seed1");
    let changed = &study.runs[1].experiment;
    assert_eq!((changed.steps, changed.agent["gamma"].as_float()), (9, Some(0.5)));
    for (only, expected) in [
        (&["sede=1"][..], "--only names sede, which is no axis"),
        (&[], "seed is an axis, and --set has it, too"),
    ] {
        let error = read_with(&axes, only, &["seed=3"]).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn a_run_on_another_dataset_is_refused() {
    let run = read("axes = { task = ['hopper-demo'], seed = [0] }").unwrap().runs.remove(0);
    let folder = tempfile::tempdir().unwrap();
    let state = |dataset: &str| {
        let path = folder.path().join(dataset);
        let mut config = crate::fixtures::config("run", 0);
        config.experiment = run.experiment.clone();
        config.experiment.dataset = Some(dataset.to_owned());
        RunDir::create(&path, &config).unwrap();
        run.state(&path)
    };
    assert_eq!(state("x.hdf5").unwrap(), State::Begun(0));
    let error = state("y.hdf5").unwrap_err().to_string();
    assert!(error.ends_with("than the study's: dataset"), "{error}");
}

#[test]
fn the_studies_of_the_repository() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../studies");
    for (name, runs) in [
        // Without two methods in mazes.
        ("table1", (15 * 12 - 6 * 2) * 4),
        ("table2", 7 * 2 * 4),
        ("tau", 15 * 5 * 4),
        ("ogbench-mazes", 6 * 7 * 8),
        ("ogbench-manipulation", 5 * 7 * 8),
    ] {
        let study = Study::read(&folder.join(name).with_extension("toml"), &[], &[]).unwrap();
        assert_eq!(study.runs.len(), runs, "{name}");
        // The task's own steps.
        assert!(study.runs.iter().all(|run| run.experiment.steps >= 100_000), "{name}");
    }
    // One τ for all methods, some of which have no use for it.
    let study = Study::read(&folder.join("lambda.toml"), &[], &[]).unwrap();
    let doubts = BTreeSet::from_iter(study.runs.iter().flat_map(|run| &run.doubts));
    let expected = ["dac", "none"]
        .map(|name| format!("agent.tau has no effect on a policy with guidance {name}"));
    assert!(doubts.into_iter().eq(&expected));
    // The example of the documentation: 3 tasks, 2 methods, 2 values of τ and 3 seeds, without dac
    // in the maze, and with one τ for dac.
    let page = include_str!("../../../../studies/README.md");
    let (_, example) = page.split_once("```toml\n").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("example.toml");
    std::fs::write(&path, example.split_once("```").unwrap().0).unwrap();
    assert_eq!(Study::read(&path, &[], &[]).unwrap().runs.len(), (2 * (1 + 2) + 2) * 3);
}
