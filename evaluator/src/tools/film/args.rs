//! The arguments of `evaluator film`.

use std::path::PathBuf;

use clap::Args;

use super::output::{Output, output};

const AFTER_HELP: &str = "\
Examples:
  # The first episode of a run's best evaluation, as an animation that any browser shows.
  evaluator film runs/mine --out film.gif

  # The same with an early snapshot beside it, from the same start, as eight pictures in a row.
  evaluator film runs/mine --compare runs/mine/snapshots/step_000002000.safetensors --out film.png

A film needs no GPU and no screen, but Mesa's software driver: apt-get install --no-install-recommends libegl1 libegl-mesa0 \
libgl1-mesa-dri";

/// Film an episode of a saved policy: an animation, a video or a strip of pictures
///
/// The episode is one on which the run evaluates the snapshot, so its return equals the one in the
/// run (with the same arithmetic).
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct FilmArgs {
    /// A snapshot, or the folder of a run: then the snapshot with the best complete evaluation, or
    /// the newest if there is none
    #[arg(value_name = "SNAPSHOT|RUN")]
    pub subject: PathBuf,
    /// The snapshot of this gradient step, if a run's folder is given
    #[arg(long, value_name = "N")]
    pub step: Option<u64>,
    /// Another snapshot or run to show beside the first, in an episode of the same seed
    #[arg(long, value_name = "SNAPSHOT|RUN")]
    pub compare: Option<PathBuf>,
    /// Seed of the episode, as in scores.jsonl and `evaluator score --json` [default: the first on
    /// which the run evaluates the snapshot]
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// File to write: .gif (320 × 240), .mp4 (480 × 360, by ffmpeg) or .png (eight pictures in a
    /// row)
    #[arg(long, value_name = "FILE", default_value = "film.gif", value_parser = output)]
    pub out: Output,
}
