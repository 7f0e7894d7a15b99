//! Summary of λ in a run of QUAD: it says if the critics' uncertainty changed the guidance.

use std::collections::BTreeMap;

use serde_json::json;

use crate::definition::{MetricsLine, Summary};

/// The first tenth of a run is skipped: critics that have learned little agree by chance.
const PARTS: u64 = 10;
/// A weight above this counts as none.
const ONE: f64 = 0.99;

/// Summarizes λ after the first tenth of the steps done so far, if there was any. `variant` is the
/// run's guidance.
pub(super) fn summarize(lines: &[MetricsLine], variant: &str) -> Option<Summary> {
    let mut lines = Vec::from_iter(
        lines.iter().filter(|line| line.contains_key("variance_ratio") && variant != "none"),
    );
    let step = |line: &MetricsLine| line.get("step").map_or(0, |step| *step as u64);
    let to_step = step(lines.last()?);
    let from_step = to_step / PARTS + 1;
    lines.retain(|line| step(line) >= from_step);
    let mut sums: BTreeMap<&str, (f64, u32)> = BTreeMap::new();
    let values = lines.iter().flat_map(|line| line.iter());
    for (name, value) in values.filter(|(name, _)| is_summarized(name)) {
        let (sum, count) = sums.entry(name).or_default();
        (*sum, *count) = (*sum + value, *count + 1);
    }
    let mean = |(name, (sum, count))| (name, sum / f64::from(count));
    let means: BTreeMap<_, _> = sums.into_iter().map(mean).collect();
    let mut lambda_means = lines.iter().map(|line| line.get("lambda_mean"));
    let is_dac = lambda_means.all(|mean| mean.is_some_and(|mean| *mean > ONE));
    let mut text = text(&means, from_step, to_step);
    if is_dac && variant != "dac" {
        text.push_str("λ stayed above 0.99: this run is DAC to within 1 %\n");
    }
    let mut json = json!({ "from_step": from_step, "to_step": to_step, "is_dac": is_dac });
    for (name, mean) in means {
        json[name] = mean.into();
    }
    let (key, title) = ("lambda", "λ");
    Some(Summary { key, title, json, text })
}

fn text(means: &BTreeMap<&str, f64>, from_step: u64, to_step: u64) -> String {
    let mean = |name: &str| means.get(name).copied().unwrap_or_default();
    let [low, median, high] =
        [10, 50, 90].map(|percent| mean(&format!("lambda_quantile_{percent}")));
    let fifth = |fifth| means.get(&*format!("lambda_fifth_{fifth}"));
    let fifths = [1, 2, 3, 4, 5]
        .map(|part| fifth(part).map_or_else(|| "–".to_owned(), |mean| format!("{mean:.3}")));
    format!(
        "λ in steps {from_step} to {to_step}: mean {:.3}, of a batch 10 % below {low:.3}, 50 % below {median:.3}, 90 % below \
         {high:.3}; {:.1} % above {ONE}\n\
         λ from the first to the last fifth of the denoising steps t = 1…T: {}\n\
         σ²/ν̂² {:.3}, cosine of guidance and behavior cloning {:.3}\n",
        mean("lambda_mean"),
        100.0 * mean("lambda_above_99_share"),
        fifths.join(" "),
        mean("variance_ratio"),
        mean("guidance_cosine"),
    )
}

fn is_summarized(name: &str) -> bool {
    name.starts_with("lambda_") || ["variance_ratio", "guidance_cosine"].contains(&name)
}

#[cfg(test)]
mod tests;
