//! A study's file: what its runs share, the axes, and rules; and the runs that follow from it, all
//! of them checked.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::{Context, anyhow, ensure};
use quad_protocol::Name;
use quad_run::config::{ConfigError, Experiment, Preset, did_you_mean, settings, tables};
use quad_run::folder::RunDir;
use quad_run::results::RunReport;
use quad_run::status::State;
use quad_runtime::{Hint, hinted, hints, one_line};
use serde::Deserialize;
use toml::{Table, Value};
use tracing::warn;

use super::axes::{Combination, axes, combinations};
use super::names;
use super::rules::{Narrower, Rules};
use crate::data::Source;

/// Keys that are no keys of an experiment: the first two say what a run begins from, the third
/// names a table of changes.
const BEGIN: [&str; 2] = ["task", "preset"];
const METHOD: &str = "method";

const HELP: &str =
    "studies/demo.toml is an example, studies/README.md has what may stand in the file";

/// The file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    /// The question, in a sentence.
    about: String,
    /// What all runs share: keys as after `--set`, and `task` or `preset`.
    #[serde(default)]
    run: Table,
    /// Lists of values by key; each combination is a run.
    axes: Table,
    /// What each value of the axis `method` changes.
    #[serde(default)]
    method: BTreeMap<String, Table>,
    #[serde(default)]
    only: Vec<Table>,
    #[serde(default)]
    except: Vec<Table>,
}

/// All that is wrong with a file.
struct Wrong {
    what: Vec<String>,
    /// What to do about it.
    advice: BTreeSet<String>,
}

impl From<Vec<String>> for Wrong {
    fn from(what: Vec<String>) -> Self {
        Self { what, advice: BTreeSet::new() }
    }
}

/// A study.
#[derive(Debug)]
pub(crate) struct Study {
    /// The file's name without its ending.
    pub name: String,
    /// The question.
    pub about: String,
    /// Its runs, in the order of their numbers.
    pub runs: Vec<PlannedRun>,
}

/// One run of a study.
#[derive(Clone, Debug)]
pub(crate) struct PlannedRun {
    /// Its number, from 0.
    pub index: usize,
    /// Its folder's name.
    pub name: String,
    /// What it begins from: a task, or a file of the user's.
    pub preset: String,
    /// What it changes in that.
    pub changes: Table,
    /// Both together.
    pub experiment: Experiment,
    /// What it learns from.
    pub source: Source,
}

impl PlannedRun {
    /// How far the run in a folder is.
    ///
    /// # Errors
    /// A run with other settings is there.
    pub fn state(&self, dir: &Path) -> anyhow::Result<State> {
        if !RunDir::is_occupied(dir) {
            return Ok(RunDir::at(dir).failure().map_or(State::NotBegun, |_| State::Failed(0)));
        }
        let read = RunReport::scored(dir).inspect_err(|error| warn!("{}", one_line(error)));
        let Ok(report) = read else { return Ok(State::Unreadable) };
        let (there, planned) = (&report.config.experiment, &self.experiment);
        let (old, new) = (settings::of_experiment(there), settings::of_experiment(planned));
        let mut differences: Vec<_> =
            settings::differences(&old, &new).map(String::as_str).collect();
        if there.dataset != planned.dataset {
            differences.push("dataset");
        }
        if !differences.is_empty() {
            let (path, keys) = (dir.display(), differences.join(", "));
            let hint = "give the study's file another name, choose another folder for it, or move that folder away";
            return Err(hinted(
                anyhow!("{path} has a run of other settings than the study's: {keys}"),
                hint,
            ));
        }
        Ok(State::of(&report)?)
    }
}

impl Study {
    /// Reads a file and resolves every run as `learner train` would. `only` has values of axes, one
    /// of which a run must have of each that is named; `set` has keys that all runs change.
    ///
    /// # Errors
    /// Everything that is wrong in it, at once.
    pub fn read(path: &Path, only: &[Table], set: &[Table]) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))
            .hint(HELP)?;
        let cannot = || format!("{} cannot be used", path.display());
        let file: File = toml::from_str(&text).with_context(cannot).hint(HELP)?;
        let name =
            path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        let refuse = |Wrong { what, advice }: Wrong| {
            let advice =
                advice.iter().map(String::as_str).chain([HELP]).collect::<Vec<_>>().join("; ");
            hinted(anyhow!("{}:\n  {}", cannot(), what.join("\n  ")), advice)
        };
        let runs = file.runs(only, set).map_err(refuse)?;
        Ok(Self { name, about: file.about, runs })
    }
}

impl File {
    fn runs(&self, only: &[Table], set: &[Table]) -> Result<Vec<PlannedRun>, Wrong> {
        let axes = axes(&self.axes)?;
        let all = combinations(&axes);
        let rules = Rules { only: &self.only, except: &self.except };
        let narrower = Narrower::new(only);
        let wrong = [rules.wrong(&all), narrower.wrong(&all)].concat();
        if !wrong.is_empty() {
            return Err(wrong.into());
        }
        let allowed = all.into_iter().filter(|combination| rules.allow(combination)).enumerate();
        let allowed =
            Vec::from_iter(allowed.filter(|(_, combination)| narrower.allows(combination)));
        let (mut runs, mut wrong) =
            (Vec::<PlannedRun>::new(), BTreeMap::<String, Vec<String>>::new());
        let mut advice = BTreeSet::new();
        for (index, combination) in allowed {
            let name = names::name(&combination);
            match self.run(index, name.clone(), &combination, set) {
                Ok(run) if runs.iter().any(|other| other.name == run.name) => {
                    wrong.entry("two runs have this name".to_owned()).or_default().push(name);
                }
                Ok(run) => runs.push(run),
                Err(error) => {
                    advice.extend(hints(&error).map(str::to_owned));
                    wrong.entry(sentence(&error)).or_default().push(name);
                }
            }
        }
        if runs.is_empty() && wrong.is_empty() {
            return Err(vec!["the rules leave no run".to_owned()].into());
        }
        let what: Vec<_> =
            wrong.into_iter().map(|(what, names)| format!("{}: {what}", some_of(&names))).collect();
        if what.is_empty() { Ok(runs) } else { Err(Wrong { what, advice }) }
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
        let begin: Vec<Value> = BEGIN.iter().filter_map(|key| changes.remove(*key)).collect();
        let [Value::String(preset)] = &begin[..] else {
            return Err(anyhow!("it needs one of task and preset"))
                .hint("[run] may have it, or an axis");
        };
        let experiment = Preset::read(preset)
            .and_then(|preset| preset.resolve(&changes))
            .hint_of(ConfigError::hint)?;
        let dataset = experiment.dataset.as_deref().ok_or_else(|| anyhow!("it names no dataset"));
        let source = Source::parse(dataset.hint("add to [run] a line dataset = \"FILE\"")?)?;
        source.check_environment(&experiment.environment)?;
        Ok(PlannedRun { index, name, preset: preset.clone(), changes, experiment, source })
    }

    /// What a combination changes: its values and those of the command line, over those of its
    /// method, over those that all runs share.
    fn changes(
        &self,
        combination: &Combination<'_>,
        command_line: &[Table],
    ) -> anyhow::Result<Table> {
        let method = combination
            .iter()
            .find(|(key, _)| *key == METHOD)
            .map(|(_, value)| self.method(value))
            .transpose()?;
        let mut changes = Table::new();
        let tables =
            [(&self.run, "[run]")].into_iter().chain(method.map(|method| (method, "its method")));
        for (table, source) in tables.chain(command_line.iter().map(|table| (table, "--set"))) {
            for (key, value) in tables::keys(table) {
                let twice = combination.iter().any(|(axis, _)| *axis == key);
                ensure!(!twice, "{key} is an axis, and {source} has it, too");
                set(&mut changes, &key, value);
            }
        }
        combination
            .iter()
            .filter(|(key, _)| *key != METHOD)
            .for_each(|(key, value)| set(&mut changes, key, value));
        Ok(changes)
    }

    fn method(&self, value: &Value) -> anyhow::Result<&Table> {
        let known = || self.method.keys().map(String::as_str);
        let name = value.as_str().unwrap_or_default();
        let hint =
            || format!("{}add [method.{name}], with what it changes", did_you_mean(name, known()));
        self.method
            .get(name)
            .ok_or_else(|| hinted(anyhow!("there is no table [method.{name}]"), hint()))
    }
}

/// Lays a value over a table at a dotted key.
fn set(table: &mut Table, key: &str, value: &Value) {
    let below = |inner, part: &str| Value::Table(Table::from_iter([(part.to_owned(), inner)]));
    if let Value::Table(change) = key.rsplit('.').fold(value.clone(), below) {
        tables::merge(table, change);
    }
}

/// An error with its causes, of which some quote theirs, in one line.
fn sentence(error: &anyhow::Error) -> String {
    let mut sentence = String::new();
    for cause in error.chain() {
        let text = cause.to_string().trim().replace('\n', " ");
        if !sentence.contains(&text) {
            sentence = if sentence.is_empty() { text } else { sentence + ": " + &text };
        }
    }
    sentence
}

fn some_of(names: &[String]) -> String {
    let first = names.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
    if names.len() > 3 { format!("{first} and {} others", names.len() - 3) } else { first }
}

#[cfg(test)]
mod tests;
