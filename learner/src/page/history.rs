//! The metrics of a run that may be going on, thinned to what a picture can show.

use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;

use quad_run::run::new_lines;
use serde::{Serialize, Serializer};

/// Most rows that are kept: more than a chart has pixels for. Even, so that pairs of rows can
/// become one.
const MOST_ROWS: usize = 500;
/// Significant digits that are sent.
const DIGITS: usize = 5;

/// What `metrics.jsonl` says. Of a long run each row is the mean of as many lines as it takes to
/// keep the rows few.
#[derive(Debug, Serialize)]
pub(super) struct History {
    #[serde(skip)]
    path: PathBuf,
    /// Bytes of the file that are taken in.
    #[serde(skip)]
    read: u64,
    /// Lines of the file behind a whole row.
    #[serde(skip)]
    stride: usize,
    /// Lines behind the last row.
    #[serde(skip)]
    lines: usize,
    /// The metrics so far.
    names: Vec<String>,
    rows: Vec<Row>,
}

/// Means of each metric over some lines.
#[derive(Debug)]
struct Row {
    /// The last of these steps.
    step: f64,
    /// Seconds of training up to it.
    seconds: f64,
    /// The sum of each metric, in the order of the names, and how many lines have it.
    values: Vec<(f64, u32)>,
}

impl History {
    /// History of the file, of which nothing is read yet.
    pub fn of(path: PathBuf) -> Self {
        Self { path, read: 0, stride: 1, lines: 0, names: Vec::new(), rows: Vec::new() }
    }

    /// Takes in the lines that the file has more than before. A learner that went back to its
    /// checkpoint writes steps again: what was known of them is forgotten.
    ///
    /// # Errors
    /// The file cannot be read. That there is none is no error.
    pub fn refresh(&mut self) -> io::Result<()> {
        let lines = new_lines(&self.path, &mut self.read)?;
        let lines =
            lines.split(|byte| *byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok());
        for mut line in lines.collect::<Vec<BTreeMap<String, Option<f64>>>>() {
            let [step, seconds] =
                ["step", "seconds"].map(|name| line.remove(name).flatten().unwrap_or_default());
            while self.rows.pop_if(|last| last.step >= step).is_some() {
                self.lines = self.stride;
            }
            // Later phases measure other metrics.
            self.names.extend(
                line.keys().filter(|name| !self.names.contains(name)).cloned().collect::<Vec<_>>(),
            );
            self.rows.iter_mut().for_each(|row| row.values.resize(self.names.len(), (0.0, 0)));
            let value = |name: &String| {
                line.get(name).copied().flatten().map_or((0.0, 0), |value| (value, 1))
            };
            self.push(Row { step, seconds, values: self.names.iter().map(value).collect() });
        }
        Ok(())
    }

    fn push(&mut self, line: Row) {
        if self.lines < self.stride
            && let Some(last) = self.rows.last_mut()
        {
            self.lines += 1;
            last.join(&line);
            return;
        }
        if self.rows.len() == MOST_ROWS {
            let mut pairs = std::mem::take(&mut self.rows).into_iter();
            while let (Some(mut first), Some(second)) = (pairs.next(), pairs.next()) {
                first.join(&second);
                self.rows.push(first);
            }
            self.stride *= 2;
        }
        self.rows.push(line);
        self.lines = 1;
    }
}

impl Row {
    /// Also covers what follows.
    fn join(&mut self, next: &Self) {
        (self.step, self.seconds) = (next.step, next.seconds);
        for ((sum, count), (more, lines)) in self.values.iter_mut().zip(&next.values) {
            *sum += more;
            *count += lines;
        }
    }
}

/// As `[step, seconds, value …]`.
impl Serialize for Row {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let means = self.values.iter().map(|(sum, count)| sum / f64::from(*count));
        serializer.collect_seq([self.step, self.seconds].into_iter().chain(means).map(rounded))
    }
}

/// The number with few digits; nothing if it is not finite.
fn rounded(value: f64) -> Option<f64> {
    format!("{value:.*e}", DIGITS - 1).parse().ok().filter(|rounded: &f64| rounded.is_finite())
}

#[cfg(test)]
mod tests;
