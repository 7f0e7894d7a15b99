//! The metrics of a run over its steps, averaged to as many rows as a chart can show.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::PathBuf;

use quad_run::folder::new_lines;
use serde::{Serialize, Serializer};

/// More than a chart has pixels for. Even, so that pairs of rows can be merged.
const MAX_ROWS: usize = 500;

/// The contents of `metrics.jsonl`. A row is the mean of `stride` lines.
#[derive(Debug, Default, Serialize)]
pub(super) struct History {
    #[serde(skip)]
    path: PathBuf,
    /// Bytes of the file that were read.
    #[serde(skip)]
    offset: u64,
    #[serde(skip)]
    stride: usize,
    /// Lines in the last row.
    #[serde(skip)]
    lines: usize,
    names: Vec<String>,
    rows: Vec<Row>,
}

#[derive(Debug)]
struct Row {
    /// Step and training time of the last line.
    step: f64,
    seconds: f64,
    /// Sum and count of each metric's values, in the order of the names.
    values: Vec<(f64, u32)>,
}

impl History {
    pub fn new(path: PathBuf) -> Self {
        Self { path, stride: 1, ..Self::default() }
    }

    /// Reads the metrics of these names in the file's new lines. A resumed learner repeats the steps
    /// since its checkpoint: they replace the earlier ones.
    pub fn refresh(&mut self, metrics: &BTreeSet<String>) -> io::Result<()> {
        let bytes = new_lines(&self.path, &mut self.offset)?;
        for line in bytes.split(|byte| *byte == b'\n') {
            let line: Result<BTreeMap<String, Option<f64>>, _> = serde_json::from_slice(line);
            let Ok(mut line) = line else { continue };
            let mut take = |name| line.remove(name).flatten().unwrap_or_default();
            let (step, seconds) = (take("step"), take("seconds"));
            while self.rows.pop_if(|last| last.step >= step).is_some() {
                self.lines = self.stride;
            }
            // Later training phases have other metrics.
            for name in line.keys().filter(|name| metrics.contains(*name)) {
                if !self.names.contains(name) {
                    self.names.push(name.clone());
                }
            }
            for row in &mut self.rows {
                row.values.resize(self.names.len(), (0.0, 0));
            }
            let value = |name| match line.get(name) {
                Some(Some(value)) => (*value, 1),
                _ => (0.0, 0),
            };
            let values = self.names.iter().map(value).collect();
            self.push(Row { step, seconds, values });
        }
        Ok(())
    }

    fn push(&mut self, line: Row) {
        if self.lines < self.stride
            && let Some(last) = self.rows.last_mut()
        {
            self.lines += 1;
            last.merge(&line);
            return;
        }
        if self.rows.len() == MAX_ROWS {
            let mut rows = std::mem::take(&mut self.rows).into_iter();
            while let (Some(mut first), Some(second)) = (rows.next(), rows.next()) {
                first.merge(&second);
                self.rows.push(first);
            }
            self.stride *= 2;
        }
        self.rows.push(line);
        self.lines = 1;
    }
}

impl Row {
    fn merge(&mut self, next: &Self) {
        (self.step, self.seconds) = (next.step, next.seconds);
        for ((sum, count), (value, more)) in self.values.iter_mut().zip(&next.values) {
            *sum += value;
            *count += more;
        }
    }
}

/// `[step, seconds, mean, …]`, null where a metric was not measured.
impl Serialize for Row {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let means = self.values.iter().map(|(sum, count)| sum / f64::from(*count));
        let numbers = [self.step, self.seconds].into_iter().chain(means);
        // Fewer digits: a chart shows no more, and the answer is shorter.
        serializer.collect_seq(numbers.map(|number| number as f32))
    }
}

#[cfg(test)]
mod tests;
