//! Study files, and the runs that follow from them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::slice;

use anyhow::{Context, anyhow, ensure};
use quad_protocol::Name;
use quad_run::config::{ConfigError, Experiment, Preset, did_you_mean, settings, tables};
use quad_run::counted;
use quad_run::folder::RunDir;
use quad_run::results::RunReport;
use quad_run::status::State;
use quad_runtime::{Hint, hinted, one_line};
use serde::Deserialize;
use toml::{Table, Value};
use tracing::warn;

use super::combinations::{self, Combination};
use crate::data::Source;

/// Keys of [run] and [axes] that are no keys of an experiment: a run's preset, and a table of
/// changes.
const PRESETS: [&str; 2] = ["task", "preset"];
const METHOD: &str = "method";

const HELP: &str =
    "studies/demo.toml is an example, studies/README.md has what may stand in the file";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    /// The question, in a sentence.
    about: String,
    /// Common changes: keys as after `--set`, and `task` or `preset`.
    #[serde(default)]
    run: Table,
    /// Lists of values by key; each combination is a run.
    axes: Table,
    /// Changes for each value of the axis `method`.
    #[serde(default)]
    method: BTreeMap<String, Table>,
    /// If there are any, only combinations that match one of them are runs.
    #[serde(default)]
    only: Vec<Table>,
    /// Combinations that match one of them are no runs.
    #[serde(default)]
    except: Vec<Table>,
}

/// All problems of a file, and hints.
type Problems = (Vec<String>, BTreeSet<String>);

#[derive(Debug)]
pub(crate) struct Study {
    /// The file's name without its extension.
    pub name: String,
    pub about: String,
    pub runs: Vec<PlannedRun>,
}

#[derive(Clone, Debug)]
pub(crate) struct PlannedRun {
    /// Number in the study, from 0.
    pub index: usize,
    pub name: String,
    /// A task, or a file of the user's.
    pub preset: String,
    pub changes: Table,
    /// The preset with its changes.
    pub experiment: Experiment,
    /// Warnings about its settings, which other runs may share.
    pub doubts: Vec<String>,
    pub sources: Vec<Source>,
}

impl PlannedRun {
    /// The state of the run in a folder. Fails if that is a run with other settings.
    pub fn state(&self, dir: &Path) -> anyhow::Result<State> {
        if !RunDir::is_occupied(dir) {
            let failed = RunDir::at(dir).failure();
            return Ok(failed.map_or(State::NotBegun, |_| State::Failed(0)));
        }
        let report = match RunReport::scored(dir) {
            Ok(report) => report,
            Err(error) => {
                warn!("{}", one_line(&error));
                return Ok(State::Unreadable);
            }
        };
        let existing = &report.config.experiment;
        let [old, new] = [existing, &self.experiment].map(settings::from_experiment);
        let differences = settings::differences(&old, &new).map(String::as_str);
        let mut differences = Vec::from_iter(differences);
        if existing.dataset != self.experiment.dataset {
            differences.push("dataset");
        }
        if differences.is_empty() {
            return Ok(State::from_report(&report)?);
        }
        let (path, keys) = (dir.display(), differences.join(", "));
        Err(anyhow!("{path} has a run of other settings than the study's: {keys}")).hint(
            "give the study's file another name, choose another folder for it, or move that folder away",
        )
    }
}

impl Study {
    /// Reads a file and resolves every run as `learner train` would. `only` selects values of axes,
    /// `set` changes keys of all runs. Reports all problems at once.
    pub fn read(path: &Path, only: &[Table], set: &[Table]) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))
            .hint(HELP)?;
        let unusable = format!("{} cannot be used", path.display());
        let file = toml::from_str(&text).with_context(|| unusable.clone());
        let file: File = file.hint(HELP)?;
        let runs = file.runs(only, set).map_err(|(problems, hints)| {
            let mut hints = Vec::from_iter(hints);
            hints.push(HELP.to_owned());
            let error = anyhow!("{unusable}:\n  {}", problems.join("\n  "));
            hinted(error, hints.join("; "))
        })?;
        let name = path.file_stem().unwrap_or_default();
        let (name, about) = (name.to_string_lossy().into_owned(), file.about);
        Ok(Self { name, about, runs })
    }
}

impl File {
    fn runs(&self, only: &[Table], set: &[Table]) -> Result<Vec<PlannedRun>, Problems> {
        let no_hints = |problems| (problems, BTreeSet::new());
        let axes = combinations::axes(&self.axes).map_err(no_hints)?;
        let combinations = combinations::combinations(&axes);
        let (merged, mut problems) = (combinations::merge(only), Vec::new());
        for (name, rules) in [
            ("a rule [[only]]", &self.only[..]),
            ("a rule [[except]]", &self.except),
            ("--only", slice::from_ref(&merged)),
        ] {
            for problem in
                rules.iter().filter_map(|rule| combinations::problem(rule, &combinations))
            {
                problems.push(format!("{name} {problem}"));
            }
        }
        if !problems.is_empty() {
            return Err(no_hints(problems));
        }
        let is_run = |combination: &Combination<'_>| {
            let any =
                |rules: &[Table]| rules.iter().any(|rule| combinations::matches(rule, combination));
            (self.only.is_empty() || any(&self.only)) && !any(&self.except)
        };
        let (mut runs, mut hints) = (Vec::<PlannedRun>::new(), BTreeSet::new());
        let mut names_by_problem = BTreeMap::<String, Vec<String>>::new();
        for (index, combination) in combinations.into_iter().filter(is_run).enumerate() {
            if !combinations::matches(&merged, &combination) {
                continue;
            }
            let name = combinations::name(&combination);
            let problem = match self.run(index, name.clone(), &combination, set) {
                Ok(run) if runs.iter().any(|other| other.name == run.name) => {
                    "two runs have this name".to_owned()
                }
                Ok(run) => {
                    runs.push(run);
                    continue;
                }
                Err(error) => {
                    hints.extend(quad_runtime::hints(&error).map(str::to_owned));
                    one_line(&*error).trim_end().replace('\n', " ")
                }
            };
            names_by_problem.entry(problem).or_default().push(name);
        }
        match (names_by_problem.is_empty(), runs.is_empty()) {
            (true, true) => Err(no_hints(vec!["the rules leave no run".to_owned()])),
            (true, false) => Ok(runs),
            (false, _) => {
                let line = |(problem, names): (_, Vec<_>)| format!("{}: {problem}", some(&names));
                Err((names_by_problem.into_iter().map(line).collect(), hints))
            }
        }
    }

    fn run(
        &self,
        index: usize,
        name: String,
        combination: &Combination<'_>,
        set: &[Table],
    ) -> anyhow::Result<PlannedRun> {
        Name::new(&name).hint(
            "name long values by an axis `method`, which has a table of changes for each name",
        )?;
        let mut changes = self.changes(combination, set)?;
        let presets = Vec::from_iter(PRESETS.iter().filter_map(|key| changes.remove(*key)));
        let [Value::String(preset)] = &presets[..] else {
            return Err(anyhow!("it needs one of task and preset"))
                .hint("[run] may have it, or an axis");
        };
        let read = Preset::read(preset).hint_of(ConfigError::hint)?;
        let experiment = read.resolve(&changes).hint_of(ConfigError::hint)?;
        let doubts = read.doubts(&experiment, &changes)?;
        if experiment.dataset.is_empty() && experiment.definition()?.needs_data {
            return Err(anyhow!("it names no dataset"))
                .hint("add to [run] a line dataset = \"FILE\"");
        }
        let sources = Source::parse_all(&experiment.dataset)?;
        for source in &sources {
            source.check_environment(&experiment.environment)?;
        }
        let preset = preset.clone();
        Ok(PlannedRun { index, name, preset, changes, experiment, doubts, sources })
    }

    /// Changes of a combination. Later tables override earlier ones: [run], method, command line,
    /// axes.
    fn changes(
        &self,
        combination: &Combination<'_>,
        command_line: &[Table],
    ) -> anyhow::Result<Table> {
        let mut tables = vec![(&self.run, "[run]")];
        if let Some((_, name)) = combination.iter().find(|(key, _)| *key == METHOD) {
            tables.push((self.method(name)?, "its method"));
        }
        tables.extend(command_line.iter().map(|table| (table, "--set")));
        let mut changes = Table::new();
        for (table, source) in tables {
            for (key, value) in tables::keys(table) {
                let is_axis = combination.iter().any(|(axis, _)| *axis == key);
                ensure!(!is_axis, "{key} is an axis, and {source} has it, too");
                set(&mut changes, &key, value);
            }
        }
        for (key, value) in combination.iter().filter(|(key, _)| *key != METHOD) {
            set(&mut changes, key, value);
        }
        Ok(changes)
    }

    fn method(&self, value: &Value) -> anyhow::Result<&Table> {
        let name = value.as_str().unwrap_or_default();
        self.method.get(name).ok_or_else(|| {
            let similar = did_you_mean(name, self.method.keys().map(String::as_str));
            let hint = format!("{similar}add [method.{name}], with what it changes");
            hinted(anyhow!("there is no table [method.{name}]"), hint)
        })
    }
}

fn set(table: &mut Table, key: &str, value: &Value) {
    let below = |inner, part: &str| Value::Table(Table::from_iter([(part.to_owned(), inner)]));
    if let Value::Table(change) = key.rsplit('.').fold(value.clone(), below) {
        tables::merge(table, change);
    }
}

fn some(names: &[String]) -> String {
    let rest = names.len().saturating_sub(3);
    let first = names[..names.len() - rest].join(", ");
    match rest {
        0 => first,
        _ => format!("{first} and {}", counted(rest, "other")),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// The last run of a study with these axes.
    fn last_run(axes: &str) -> PlannedRun {
        let run = "run = { dataset = 'x.hdf5', steps = 7 }\nmethod.slow = { agent.gamma = 0.5 }";
        let text =
            format!("about = 'a question'\n{run}\naxes = {{ task = ['hopper-demo'], {axes} }}");
        let file: File = toml::from_str(&text).unwrap();
        file.runs(&[], &["agent.samples = 2".parse().unwrap()]).unwrap().pop().unwrap()
    }

    #[test]
    fn changes_as_flags_give_the_same_experiment() {
        let run = last_run(
            "seed = [0, 3], method = ['slow'], agent.tau = [0.1, 2], agent.critic.hidden = [[8, 8]], precision = ['bf16']",
        );
        let mut changes = Table::new();
        for (key, value) in tables::keys(&run.changes) {
            let flag = format!("{key}={value}");
            tables::merge(&mut changes, tables::parse_assignment(&flag).unwrap());
        }
        assert_eq!(quad_run::config::resolve(&run.preset, &changes).unwrap(), run.experiment);
        let (agent, seed) = (&run.experiment.agent, run.experiment.seed);
        let values = ["gamma", "tau", "samples"].map(|key| agent[key].to_string());
        assert_eq!((values.join(" "), seed, run.experiment.steps), ("0.5 2.0 2".to_owned(), 3, 7));
    }

    #[test]
    fn a_run_on_another_dataset_is_refused() {
        let (run, folder) = (last_run("seed = [0]"), tempfile::tempdir().unwrap());
        let state = |dataset: &str| {
            let path = folder.path().join(dataset);
            let mut config = crate::fixtures::config("run", 0);
            config.experiment = run.experiment.clone();
            config.experiment.dataset = vec![dataset.to_owned()];
            RunDir::create(&path, &config).unwrap();
            run.state(&path)
        };
        assert_eq!(state("x.hdf5").unwrap(), State::Begun(0));
        let error = state("y.hdf5").unwrap_err().to_string();
        assert!(error.ends_with("than the study's: dataset"), "{error}");
    }
}
