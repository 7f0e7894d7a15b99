//! The thread that reads run folders for the page. A disk that hangs holds up this thread and no
//! other.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use quad_algorithms::Metric;
use quad_run::results::RunReport;
use quad_run::run::RunDir;
use quad_run::status::list;
use quad_runtime::stay_in_background;
use serde_json::{Value, json};
use tokio::sync::oneshot;

use super::history::History;

/// However often browsers ask, a run is read no more often than this.
const RUN_EVERY: Duration = Duration::from_secs(1);
/// And the list of runs.
const LIST_EVERY: Duration = Duration::from_secs(5);
/// Most runs whose history is kept in memory.
const MOST_KEPT: usize = 64;
/// Episodes that are shown.
const EPISODES: usize = 20;

/// What a browser asks for.
pub(super) enum Question {
    /// All runs.
    Runs,
    /// The run of this name in the list.
    Run(String),
}

/// A question, and where its answer goes: JSON, or nothing if there is no such run.
pub(super) type Asked = (Question, oneshot::Sender<Option<Bytes>>);

/// The runs in or below a folder.
pub(super) struct Reader {
    root: PathBuf,
    list: Kept,
    /// Folders of the runs, by the name in the list.
    dirs: HashMap<String, PathBuf>,
    runs: HashMap<String, (RunPage, Kept)>,
}

/// The newest answer to a question, and when it was made.
type Kept = Option<(Instant, Bytes)>;

/// The answer that is kept, unless it is as old as that: then it is made anew.
fn answer(kept: &mut Kept, every: Duration, make: impl FnOnce() -> Value) -> Bytes {
    let young = kept.take().filter(|(made, _)| made.elapsed() < every);
    kept.insert(young.unwrap_or_else(|| (Instant::now(), make().to_string().into()))).1.clone()
}

impl Reader {
    pub fn new(root: PathBuf) -> Self {
        Self { root, list: None, dirs: HashMap::new(), runs: HashMap::new() }
    }

    /// Answers until the web server is gone.
    pub fn run(mut self, questions: &Receiver<Asked>) {
        stay_in_background();
        while let Ok((question, tell)) = questions.recv() {
            let found = match question {
                Question::Runs => Some(self.list()),
                Question::Run(name) => self.of_run(name),
            };
            tell.send(found).ok();
        }
    }

    fn list(&mut self) -> Bytes {
        answer(&mut self.list, LIST_EVERY, || {
            let entries = list::list(std::slice::from_ref(&self.root));
            self.dirs =
                entries.iter().map(|entry| (entry.name.clone(), entry.dir.clone())).collect();
            let shown = entries.iter().map(|entry| {
                let mut shown = json!(entry);
                if shown["at_work"] == true {
                    shown["page"] = json!(
                        RunDir::at(&entry.dir)
                            .read_endpoints()
                            .ok()
                            .map(|endpoints| endpoints.page)
                    );
                }
                shown
            });
            shown.collect()
        })
    }

    fn of_run(&mut self, name: String) -> Option<Bytes> {
        if !self.dirs.contains_key(&name) {
            self.list();
        }
        let dir = self.dirs.get(&name)?;
        if self.runs.len() >= MOST_KEPT && !self.runs.contains_key(&name) {
            self.runs.clear();
        }
        let (run, kept) = self.runs.entry(name).or_insert_with(|| (RunPage::of(dir), None));
        let read = || run.read().unwrap_or_else(|error| json!({ "error": format!("{error:#}") }));
        Some(answer(kept, RUN_EVERY, read))
    }
}

/// What the page shows of a run.
struct RunPage {
    dir: PathBuf,
    /// When the run began whose history this is.
    started: u64,
    history: History,
}

impl RunPage {
    fn of(dir: &Path) -> Self {
        Self { dir: dir.to_owned(), started: 0, history: History::of(dir.join("metrics.jsonl")) }
    }

    fn read(&mut self) -> anyhow::Result<Value> {
        let (report, scores) = RunReport::with_scores(&self.dir)?;
        let config = &report.config;
        // By --fresh, another run takes the folder of one that was looked at.
        if self.started != config.run.started {
            *self = Self { started: config.run.started, ..Self::of(&self.dir) };
        }
        self.history.refresh()?;
        let metric = |metric: &Metric| json!({ "name": metric.name, "help": metric.help });
        let metrics: Value = config.experiment.definition()?.metrics.iter().map(metric).collect();
        let evaluations = report.evaluations.iter().map(|evaluation| {
            json!([
                evaluation.step,
                evaluation.score.mean,
                evaluation.score.std,
                evaluation.episodes,
                evaluation.complete
            ])
        });
        let newest = &scores[scores.len().saturating_sub(EPISODES)..];
        Ok(json!({
            "run": report.run,
            "task": report.task,
            "agent": report.agent,
            "seed": report.seed,
            "steps": report.steps,
            "measure": report.measure(),
            "dataset_score": report.dataset_score,
            "dataset": config.dataset.summary(),
            "settings": toml::to_string(config)?,
            "metrics": metrics,
            "history": &self.history,
            "evaluations": Value::from_iter(evaluations),
            "episodes": newest,
        }))
    }
}

#[cfg(test)]
mod tests;
