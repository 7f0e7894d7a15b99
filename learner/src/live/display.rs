//! Progress for the user while the learner works: a bar with figures on a terminal, plain log lines
//! otherwise.

use std::collections::VecDeque;
use std::path::Path;
use std::time::{Duration, Instant};

use indicatif::{HumanCount, HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use quad_dataset::environment;
use quad_run::counted;
use quad_runtime::clean;
use tracing::info;

use super::metrics::Metrics;

/// Interval at which to call [`Display::tick`].
pub(super) const REDRAW: Duration = Duration::from_millis(250);
/// Interval of log lines.
const LINE: Duration = Duration::from_secs(5);
/// Number of the newest evaluations that are shown.
const SCORES_SHOWN: usize = 3;

pub(crate) struct Display {
    metrics: Metrics,
    steps: u64,
    /// Hidden if stderr is no terminal, or one that cannot draw (`TERM=dumb`). Measures the rate
    /// all the same.
    bar: ProgressBar,
    /// Gradient steps that were done before.
    first: u64,
    /// Newest last: gradient step and mean score.
    scores: VecDeque<(u64, f64)>,
    last_line: Instant,
}

impl Display {
    /// Starts the display of a run with `steps` gradient steps.
    pub fn start(metrics: Metrics, steps: u64) -> Self {
        let bar = ProgressBar::with_draw_target(Some(steps), ProgressDrawTarget::stderr());
        // If our style were wrong, the bar would still work.
        if let Ok(style) =
            ProgressStyle::with_template("{bar:40} {pos}/{len} gradient steps\n{msg}")
        {
            bar.set_style(style);
        }
        let first = metrics.training.gradient_steps.get();
        bar.set_position(first);
        bar.reset_eta();
        Self { metrics, steps, bar, first, scores: VecDeque::new(), last_line: Instant::now() }
    }

    pub fn line(&self, text: &str) {
        if self.bar.is_hidden() { info!("{text}") } else { self.bar.println(clean(text)) }
    }

    /// Adds the result of an evaluation.
    pub fn scored(&mut self, step: u64, mean: f64) {
        self.scores.push_back((step, mean));
        if self.scores.len() > SCORES_SHOWN {
            self.scores.pop_front();
        }
    }

    pub fn tick(&mut self) {
        let step = self.metrics.training.gradient_steps.get();
        self.bar.set_position(step);
        let (training, evaluation) = (self.training_figures(step), self.evaluation_figures());
        if !self.bar.is_hidden() {
            self.bar.set_message(format!("{training}\n{evaluation}"));
        } else if step < self.steps && self.last_line.elapsed() >= LINE {
            self.last_line = Instant::now();
            let percent = 100.0 * step as f64 / self.steps as f64;
            info!("step {step}/{} ({percent:.0} %), {training}, {evaluation}", self.steps);
        }
    }

    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }

    fn training_figures(&self, step: u64) -> String {
        let training = &self.metrics.training;
        let mut parts = Vec::new();
        if step < self.steps {
            parts.push(format!("{:.1} steps/s", self.bar.per_sec()));
            if step > self.first {
                parts.push(format!("{} left", HumanDuration(self.bar.eta())));
            }
        }
        for (metric, gauge) in &training.algorithm {
            if let Some(value) = gauge.get().filter(|_| !metric.label.is_empty()) {
                parts.push(format!("{} {value:.3}", metric.label));
            }
        }
        parts.extend(self.online_figures());
        parts.join(", ")
    }

    /// `experience 12,300 of 50,000, return 310`, once there is some.
    fn online_figures(&self) -> Option<String> {
        let online = &self.metrics.online;
        let (rows, target) = (online.rows.get() as u64, online.target.get() as u64);
        let (rows, target) = (HumanCount((rows > 0).then_some(rows)?), HumanCount(target));
        Some(format!("experience {rows} of {target}, return {:.0}", online.episode_return.get()))
    }

    fn evaluation_figures(&self) -> String {
        let mut parts = vec![evaluators(self.metrics.evaluators.present.get())];
        let pending = self.metrics.evaluation.episodes_pending.get();
        if pending > 0 {
            parts.push(format!("{} to score", counted(pending as usize, "episode")));
        }
        let scores = self.scores.iter().map(|(step, mean)| format!("{mean:.1} @{step}"));
        if !self.scores.is_empty() {
            parts.push(format!("scores {}", Vec::from_iter(scores).join(", ")));
        }
        parts.join(", ")
    }
}

/// `no evaluator`, `1 evaluator`, `2 evaluators`.
pub(super) fn evaluators(count: i64) -> String {
    match count {
        0 => "no evaluator".to_owned(),
        _ => counted(count as usize, "evaluator"),
    }
}

/// Advice for a run without an evaluator that has its environment. `log` is that of an evaluator
/// which the learner has started.
pub(super) fn advice(environment: &str, endpoint: &str, log: Option<&Path>) -> String {
    match (environment::find(environment), log) {
        (Ok(_), Some(log)) => format!(
            "this learner's evaluators have not connected yet; if they do not, their log may say why: {}",
            log.display()
        ),
        (Ok(_), None) => {
            format!("no evaluator is here; start one with: evaluator serve --connect {endpoint}")
        }
        (Err(_), _) => format!(
            "no evaluator is here that has the environment {environment}; from Python: \
             quad_rl.evaluate(\"{environment}\", YOUR_ENVIRONMENT, connect=\"{endpoint}\") (docs/python.md)"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// On a busy machine evaluators take longer to start than the learner takes to train.
    #[test]
    fn the_advice_depends_on_the_environment_and_the_learners_own_evaluators() {
        let log = Some(Path::new("runs/mine/evaluator-1.log"));
        for (environment, log, expected) in [
            ("hopper", None, "start one with: evaluator serve --connect tcp/127.0.0.1:7447"),
            ("hopper", log, "may say why: runs/mine/evaluator-1.log"),
            ("my-robot", log, "quad_rl.evaluate(\"my-robot\""),
        ] {
            let advice = advice(environment, "tcp/127.0.0.1:7447", log);
            assert!(advice.contains(expected), "{advice}");
        }
    }
}
