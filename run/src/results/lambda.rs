//! What λ was in a run of QUAD, from its `metrics.jsonl`: whether the critics' uncertainty changed the guidance.

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use anyhow::Context;
use serde::Serialize;

/// The first of so many parts of a run does not count: critics that have learnt little agree by chance.
const PARTS: u64 = 10;
/// A weight above this is taken for no weight.
const ONE: f64 = 0.99;

/// What λ was after the first tenth of the steps that a run has made so far.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LambdaReport {
    /// Gradient steps before this one are left out.
    from_step: u64,
    /// The last gradient step of which there are metrics.
    to_step: u64,
    /// Whether the batch's mean of λ was above 0.99 in every line of the file.
    is_dac: bool,
    /// Means over the lines by the metrics' names (docs/metrics.md).
    #[serde(flatten)]
    means: BTreeMap<String, f64>,
}

impl LambdaReport {
    /// Reads it from a run folder. `None` without guidance, and where nothing is written yet or it holds nothing of λ.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn read(folder: &Path, variant: &str) -> anyhow::Result<Option<Self>> {
        let path = folder.join("metrics.jsonl");
        match fs::read_to_string(&path) {
            Ok(text) if variant != "none" => Ok(Self::of(&text)),
            Err(error) if error.kind() != ErrorKind::NotFound => {
                Err(error).with_context(|| format!("cannot read {}", path.display()))
            }
            _ => Ok(None),
        }
    }

    fn of(text: &str) -> Option<Self> {
        // The last line may not be complete.
        let lines = text.lines().filter_map(|line| serde_json::from_str::<BTreeMap<String, f64>>(line).ok());
        let mut lines: Vec<_> = lines.filter(|line| line.contains_key("variance_ratio")).collect();
        let step = |line: &BTreeMap<String, f64>| line.get("step").map_or(0, |step| *step as u64);
        let to_step = step(lines.last()?);
        let from_step = to_step / PARTS + 1;
        lines.retain(|line| step(line) >= from_step);
        let mut means = BTreeMap::new();
        for (name, value) in lines.iter().flatten().filter(|(name, _)| is_told(name)) {
            *means.entry(name.clone()).or_default() += value / lines.len() as f64;
        }
        let is_dac = lines.iter().all(|line| line.get("lambda_mean").is_some_and(|mean| *mean > ONE));
        Some(Self { from_step, to_step, is_dac, means })
    }

    /// As lines for people. `variant` is the run's guidance.
    pub fn text(&self, variant: &str) -> String {
        let mean = |name: &str| self.means.get(name).copied().unwrap_or_default();
        let [low, median, high] = [10, 50, 90].map(|percent| mean(&format!("lambda_quantile_{percent}")));
        let fifths = [1, 2, 3, 4, 5].map(|fifth| format!("{:.3}", mean(&format!("lambda_fifth_{fifth}"))));
        let mut text = format!(
            "\nλ in steps {} to {}: mean {:.3}, of a batch 10 % below {low:.3}, 50 % below {median:.3}, 90 % below {high:.3}; \
             {:.1} % above {ONE}\n\
             λ from the first to the last fifth of the denoising steps t = 1…T: {}\n\
             σ²/ν̂² {:.3}, cosine of guidance and behaviour cloning {:.3}\n",
            self.from_step,
            self.to_step,
            mean("lambda_mean"),
            100.0 * mean("lambda_above_99_share"),
            fifths.join(" "),
            mean("variance_ratio"),
            mean("guidance_cosine"),
        );
        if self.is_dac && variant != "dac" {
            text.push_str("λ stayed above 0.99: this run is DAC to within 1 %\n");
        }
        text
    }
}

fn is_told(name: &str) -> bool {
    name.starts_with("lambda_") || ["variance_ratio", "guidance_cosine"].contains(&name)
}

#[cfg(test)]
mod tests;
