//! Reads run folders for the page.

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::slice;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use quad_run::folder::RunDir;
use quad_run::results::RunReport;
use quad_run::status::list;
use serde_json::{Value, json};

use super::history::History;
use crate::train::{COLUMNS, held_out_name};

const RUN_LIFETIME: Duration = Duration::from_secs(1);
const LIST_LIFETIME: Duration = Duration::from_secs(5);
/// Runs whose history is kept in memory.
const MAX_RUNS: usize = 64;
const EPISODES: usize = 20;

#[derive(Default)]
pub(super) struct Reader {
    root: PathBuf,
    list: Cache,
    dirs: HashMap<String, PathBuf>,
    runs: HashMap<String, (RunPage, Cache)>,
}

#[derive(Default)]
struct Cache(Option<(Instant, Bytes)>);

impl Cache {
    fn get(&mut self, lifetime: Duration, read: impl FnOnce() -> Value) -> Bytes {
        let fresh = self.0.take().filter(|(made, _)| made.elapsed() < lifetime);
        let answer = fresh.unwrap_or_else(|| (Instant::now(), read().to_string().into()));
        self.0.insert(answer).1.clone()
    }
}

impl Reader {
    pub fn new(root: PathBuf) -> Self {
        Self { root, ..Self::default() }
    }

    /// The list of runs as JSON.
    pub fn list(&mut self) -> Bytes {
        self.list.get(LIST_LIFETIME, || {
            let entries = list::list(slice::from_ref(&self.root));
            let named = |entry: &list::Entry| (entry.name.clone(), entry.dir.clone());
            self.dirs = entries.iter().map(named).collect();
            let with_page = |entry: &list::Entry| {
                let mut json = json!(entry);
                if json["at_work"] == true {
                    let endpoints = RunDir::at(&entry.dir).read_endpoints();
                    json["page"] = json!(endpoints.ok().map(|endpoints| endpoints.page));
                }
                json
            };
            entries.iter().map(with_page).collect()
        })
    }

    /// The run of this name in the list as JSON; nothing if there is none.
    pub fn run_page(&mut self, name: String) -> Option<Bytes> {
        if !self.dirs.contains_key(&name) {
            self.list();
        }
        let dir = self.dirs.get(&name)?;
        if self.runs.len() >= MAX_RUNS && !self.runs.contains_key(&name) {
            self.runs.clear();
        }
        // Runs of two studies may have the same name.
        let shown = (*dir != self.root).then(|| name.clone());
        let new = || (RunPage::new(dir), Cache::default());
        let (run, cache) = self.runs.entry(name).or_insert_with(new);
        let failed = |error| json!({ "error": format!("{error:#}") });
        Some(cache.get(RUN_LIFETIME, || {
            let mut page = run.read().unwrap_or_else(failed);
            if let Some(name) = shown {
                page["run"] = name.into();
            }
            page
        }))
    }
}

pub(super) struct RunPage {
    dir: PathBuf,
    /// Start time of the run whose history this is.
    started: u64,
    history: History,
}

impl RunPage {
    pub fn new(dir: &Path) -> Self {
        Self { dir: dir.to_owned(), started: 0, history: History::new(dir.join("metrics.jsonl")) }
    }

    pub fn read(&mut self) -> anyhow::Result<Value> {
        let (report, scores) = RunReport::with_scores(&self.dir)?;
        let config = &report.config;
        // After --fresh, another run has the folder.
        if self.started != config.run.started {
            *self = Self { started: config.run.started, ..Self::new(&self.dir) };
        }
        let metrics = config.experiment.definition()?.metrics;
        let mut names = BTreeSet::from(COLUMNS.map(|(name, _)| name.to_owned()));
        names.extend(
            metrics.iter().flat_map(|metric| [metric.name.to_owned(), held_out_name(metric)]),
        );
        self.history.refresh(&names)?;
        let online = config.experiment.online.iter().flat_map(|_| COLUMNS);
        let metrics = metrics.iter().map(|metric| (metric.name, metric.help)).chain(online);
        let metrics = metrics.map(|(name, help)| json!({ "name": name, "help": help }));
        let evaluations = report.evaluations.iter().map(|evaluation| {
            let (step, score) = (evaluation.step, evaluation.score);
            json!([step, score.mean, score.std, evaluation.episodes, evaluation.complete])
        });
        Ok(json!({
            "run": report.run,
            "task": report.task,
            "agent": report.agent,
            "seed": report.seed,
            "steps": report.steps,
            "online_begins": config.experiment.online_begins(),
            "measure": report.measure(),
            "dataset_score": report.dataset_measure(),
            "dataset": config.dataset.summary(),
            "settings": toml::to_string(config)?,
            "metrics": Value::from_iter(metrics),
            "history": &self.history,
            "evaluations": Value::from_iter(evaluations),
            "episodes": &scores[scores.len().saturating_sub(EPISODES)..],
        }))
    }
}
