//! What the user sees while the learner works: a bar with figures on a terminal, plain log lines otherwise.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use tracing::info;

use super::metrics::Metrics;

/// How often the figures on a terminal change.
const REDRAW: Duration = Duration::from_millis(250);
/// How often a log gets a line.
const LINE: Duration = Duration::from_secs(5);
/// Window over which the rate is measured.
const RATE_WINDOW: Duration = Duration::from_secs(15);
/// How long training runs before the forecast of its duration.
const ESTIMATE: Duration = Duration::from_secs(3);
/// How many of the newest evaluations are shown.
const SCORES_SHOWN: usize = 3;

/// Shows the progress of a run.
pub(crate) struct Display {
    metrics: Metrics,
    steps: u64,
    /// `None` if stderr is no terminal, or one that cannot draw (`TERM=dumb`).
    bar: Option<ProgressBar>,
    samples: VecDeque<(Instant, u64)>,
    /// Newest last: gradient step and mean score.
    scores: VecDeque<(u64, f64)>,
    last_line: Instant,
    /// Whether the forecast has been printed.
    estimated: bool,
}

impl Display {
    /// Starts the display of a run with `steps` gradient steps.
    pub fn start(metrics: Metrics, steps: u64) -> Self {
        let bar = ProgressBar::with_draw_target(Some(steps), ProgressDrawTarget::stderr());
        // Without our style the bar still works, but shows less.
        if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} gradient steps\n{msg}") {
            bar.set_style(style);
        }
        Self {
            metrics,
            steps,
            bar: Some(bar).filter(|bar| !bar.is_hidden()),
            samples: VecDeque::new(),
            scores: VecDeque::new(),
            last_line: Instant::now(),
            estimated: false,
        }
    }

    /// How often [`tick`](Self::tick) wants to be called.
    pub fn interval(&self) -> Duration {
        REDRAW
    }

    /// Prints an event as a line.
    pub fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.println(text),
            None => info!("{text}"),
        }
    }

    /// Adds the result of an evaluation.
    pub fn scored(&mut self, step: u64, mean: f64) {
        self.scores.push_back((step, mean));
        if self.scores.len() > SCORES_SHOWN {
            self.scores.pop_front();
        }
    }

    /// Updates the figures.
    pub fn tick(&mut self, now: Instant) {
        let step = self.metrics.training.gradient_steps.get();
        let training = step < self.steps;
        self.samples.push_back((now, step));
        while self.samples.front().is_some_and(|(then, _)| now.duration_since(*then) > RATE_WINDOW) {
            self.samples.pop_front();
        }
        self.estimate(step, now);
        match &self.bar {
            Some(bar) => {
                bar.set_position(step);
                bar.set_message(format!("{}\n{}", self.training_figures(step), self.evaluation_figures()));
            }
            None if training && now.duration_since(self.last_line) >= LINE => {
                self.last_line = now;
                let percent = 100.0 * step as f64 / self.steps as f64;
                let (training, evaluation) = (self.training_figures(step), self.evaluation_figures());
                info!("step {step}/{} ({percent:.0} %), {training}, {evaluation}", self.steps);
            }
            None => {}
        }
    }

    /// Prints once how long training will take, if that is more than a minute: the user may have meant fewer steps.
    fn estimate(&mut self, step: u64, now: Instant) {
        let Some(&(begin, first)) = self.samples.front() else { return };
        let rate = self.rate();
        if self.estimated || now.duration_since(begin) < ESTIMATE || step == first || rate <= 0.0 {
            return;
        }
        self.estimated = true;
        let left = Duration::from_secs_f64((self.steps - step.min(self.steps)) as f64 / rate);
        if left > Duration::from_secs(60) {
            self.say(&format!("{rate:.1} steps/s: this takes about {}", HumanDuration(left)));
        }
    }

    /// Removes the bar.
    pub fn finish(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }

    fn training_figures(&self, step: u64) -> String {
        let training = &self.metrics.training;
        let mut parts = Vec::new();
        if step < self.steps {
            let rate = self.rate();
            parts.push(format!("{rate:.1} steps/s"));
            if rate > 0.0 {
                let left = Duration::from_secs_f64((self.steps - step) as f64 / rate);
                parts.push(format!("{} left", HumanDuration(left)));
            }
        }
        let shown = training.algorithm.iter().filter(|(metric, _)| !metric.label.is_empty());
        parts.extend(shown.map(|(metric, gauge)| format!("{} {:.3}", metric.label, gauge.get())));
        parts.join(", ")
    }

    fn evaluation_figures(&self) -> String {
        let mut parts = vec![evaluators(self.metrics.evaluators.present.get())];
        let pending = self.metrics.evaluation.episodes_pending.get();
        if pending > 0 {
            parts.push(format!("{pending} episodes to score"));
        }
        if !self.scores.is_empty() {
            let scores: Vec<_> = self.scores.iter().map(|(step, mean)| format!("{mean:.1} @{step}")).collect();
            parts.push(format!("scores {}", scores.join(", ")));
        }
        parts.join(", ")
    }

    fn rate(&self) -> f64 {
        let (Some((start, first)), Some((end, last))) = (self.samples.front(), self.samples.back()) else { return 0.0 };
        let seconds = end.duration_since(*start).as_secs_f64();
        if seconds > 0.0 { (last - first) as f64 / seconds } else { 0.0 }
    }
}

/// "2 evaluators".
pub(super) fn evaluators(count: i64) -> String {
    match count {
        0 => "no evaluator".to_owned(),
        1 => "1 evaluator".to_owned(),
        _ => format!("{count} evaluators"),
    }
}
