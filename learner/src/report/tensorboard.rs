//! A run's metrics and scores as TensorBoard reads them: an event file, made of what the run folder has.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, anyhow};
use quad_runs::results::run::{EvaluationReport, RunReport};
use quad_runs::run::new_lines;
use quad_runtime::hinted;

/// What the name of an event file begins with, by which TensorBoard finds it.
const PREFIX: &str = "events.out.tfevents.";
/// What it ends with, if it is ours.
const SUFFIX: &str = ".quad";

/// Writes an event file of each run.
///
/// # Errors
/// Two runs have one name, a run cannot be read, or a file cannot be written.
pub(crate) fn export_all(runs: &[RunReport], folder: &Path) -> anyhow::Result<()> {
    let mut named = BTreeMap::new();
    for run in runs {
        if let Some(other) = named.insert(&run.run, &run.dir) {
            let (other, dir) = (other.display(), run.dir.display());
            let error = anyhow!("{other} and {dir} both have a run named {}", run.run);
            return Err(hinted(error, "export them one at a time, into different folders"));
        }
        Exporter::new(&run.dir, folder).append()?;
    }
    Ok(())
}

/// Copies a run to an event file, piece by piece while a learner trains.
pub(crate) struct Exporter {
    run: PathBuf,
    folder: PathBuf,
    /// None before the first copy, and after an error: the file may end in half a record then.
    file: Option<EventFile>,
}

impl Exporter {
    /// For the run in the folder `run`. The file will lie in a folder of the run's name in `folder`.
    pub fn new(run: &Path, folder: &Path) -> Self {
        Self { run: run.to_owned(), folder: folder.to_owned(), file: None }
    }

    /// Appends what the run has written since the last call. The first call begins a file, in place of those of earlier
    /// exporters.
    ///
    /// # Errors
    /// The run cannot be read, or the file cannot be written; the next call begins a file then.
    pub fn append(&mut self) -> anyhow::Result<()> {
        let report = RunReport::scored(&self.run)?;
        let complete: Vec<_> = report.evaluations.iter().filter(|evaluation| evaluation.complete).collect();
        // TensorBoard drops what it has of later steps when an earlier one follows, so an evaluation that is complete after
        // a later one needs a file from the start.
        let goes_on = |file: &EventFile| {
            let steps = complete.iter().map(|evaluation| evaluation.step).take(file.evaluated.len());
            steps.eq(file.evaluated.iter().copied()) && file.is_intact()
        };
        let mut file = match self.file.take().filter(goes_on) {
            Some(file) => file,
            None => EventFile::begin(&self.folder.join(&report.run), report.config.run.started)?,
        };
        let mut records = file.rows(&self.run.join("metrics.jsonl"))?;
        records.extend(file.evaluations(&complete));
        file.write(&records)?;
        self.file = Some(file);
        Ok(())
    }
}

/// The file that is written, and how much of the run is in it.
struct EventFile {
    path: PathBuf,
    file: File,
    /// Bytes written.
    length: u64,
    /// When the run began, in seconds since 1970.
    started: f64,
    /// So many bytes of `metrics.jsonl`.
    read: u64,
    /// The time of each row, by its step, as `metrics.jsonl` has it.
    seconds: BTreeMap<u64, f64>,
    /// The steps of the evaluations.
    evaluated: Vec<u64>,
}

impl EventFile {
    /// Begins a file in a folder, in place of earlier ones. `started` is in milliseconds since 1970.
    fn begin(folder: &Path, started: u64) -> anyhow::Result<Self> {
        fs::create_dir_all(folder).with_context(|| cannot("create", folder))?;
        let now = SystemTime::now().duration_since(UNIX_EPOCH)?;
        // TensorBoard goes on to the file whose name is the larger one.
        let path = folder.join(format!("{PREFIX}{}.{:03}{SUFFIX}", now.as_secs(), now.subsec_millis()));
        let mut earlier = event_files(folder).with_context(|| cannot("read", folder))?;
        let started = Duration::from_millis(started).as_secs_f64();
        // The format's version; then a start at step 0, at which a TensorBoard that is open forgets an earlier file.
        let begin = [field(0x1a, b"brain.Event:2"), field(0x3a, &[0x08, 1])].map(|fields| event(started, 0, &fields));
        let file = File::create(&path).with_context(|| cannot("create", &path))?;
        let mut begun =
            Self { path, file, length: 0, started, read: 0, seconds: BTreeMap::new(), evaluated: Vec::new() };
        begun.write(&begin.concat())?;
        // A TensorBoard that is open reads the newest one, and goes on to this one only while that is there.
        if let Some(newest) = earlier.pop() {
            File::create(&newest).with_context(|| cannot("empty", &newest))?;
        }
        for old in earlier {
            fs::remove_file(&old).with_context(|| cannot("remove", &old))?;
        }
        Ok(begun)
    }

    /// Whether it is as it was written: it may have been removed, or another exporter may have begun another one.
    fn is_intact(&self) -> bool {
        fs::metadata(&self.path).is_ok_and(|found| found.len() == self.length)
    }

    fn write(&mut self, records: &[u8]) -> anyhow::Result<()> {
        self.length += records.len() as u64;
        self.file.write_all(records).with_context(|| cannot("write", &self.path))
    }

    /// The records of the whole lines of `metrics.jsonl` that are not in the file yet.
    fn rows(&mut self, path: &Path) -> anyhow::Result<Vec<u8>> {
        let lines = new_lines(path, &mut self.read).with_context(|| cannot("read", path))?;
        let mut records = Vec::new();
        let rows = lines.split(|byte| *byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok());
        for mut row in rows.collect::<Vec<BTreeMap<String, f64>>>() {
            let (step, seconds) = (row.remove("step").unwrap_or_default(), row.remove("seconds").unwrap_or_default());
            self.seconds.insert(step as u64, seconds);
            let values = row.iter().map(|(name, value)| (format!("train/{name}"), *value));
            records.extend(scalars(self.started + seconds, step as u64, values));
        }
        Ok(records)
    }

    /// Those of the complete evaluations that are not in it yet, at the times of their steps.
    fn evaluations(&mut self, complete: &[&EvaluationReport]) -> Vec<u8> {
        let mut records = Vec::new();
        for evaluation in &complete[self.evaluated.len()..] {
            let EvaluationReport { step, score, mean_return, mean_length, .. } = **evaluation;
            let seconds = self.seconds.range(..=step).next_back().map_or(0.0, |(_, seconds)| *seconds);
            let [value, std] = [Some(score.mean), score.std];
            let values =
                [("score", value), ("score_std", std), ("return", Some(mean_return)), ("length", Some(mean_length))];
            let values = values.into_iter().filter_map(|(name, value)| Some((format!("evaluation/{name}"), value?)));
            records.extend(scalars(self.started + seconds, step, values));
            self.evaluated.push(step);
        }
        records
    }
}

fn cannot(what: &str, path: &Path) -> String {
    format!("cannot {what} {}", path.display())
}

/// Our event files in a folder, the newest last.
fn event_files(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    files.retain(|path| name(path).starts_with(PREFIX) && name(path).ends_with(SUFFIX));
    files.sort();
    Ok(files)
}

/// The record of scalars, in tags, at a step.
fn scalars(time: f64, step: u64, values: impl Iterator<Item = (String, f64)>) -> Vec<u8> {
    let value = |(tag, value): (String, f64)| {
        let number = (value as f32).to_le_bytes();
        field(0x0a, &[field(0x0a, tag.as_bytes()), vec![0x15], number.to_vec()].concat())
    };
    event(time, step, &field(0x2a, &values.flat_map(value).collect::<Vec<_>>()))
}

/// The record of an Event, which is a message of Protocol Buffers: time in seconds since 1970, step, and a field more.
fn event(time: f64, step: u64, content: &[u8]) -> Vec<u8> {
    let event = [&[0x09][..], &time.to_le_bytes(), &[0x10], &varint(step), content].concat();
    let length = (event.len() as u64).to_le_bytes();
    [&length[..], &checksum(&length), &event, &checksum(&event)].concat()
}

/// A field of Protocol Buffers that has a length: its number and type in one byte, the length, the content.
fn field(tag: u8, content: &[u8]) -> Vec<u8> {
    [&[tag][..], &varint(content.len() as u64), content].concat()
}

fn varint(mut number: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while number > 0x7f {
        bytes.push(number as u8 | 0x80);
        number >>= 7;
    }
    bytes.push(number as u8);
    bytes
}

/// CRC-32C as event files have it.
fn checksum(bytes: &[u8]) -> [u8; 4] {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

#[cfg(test)]
mod tests;
