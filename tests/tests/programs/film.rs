//! `evaluator film` shows the episode that is scored, in files that others read.

use std::fs::{self, File, Permissions};
use std::io::BufReader;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use quad_tests::PATIENCE;
use quad_tests::learner::Learner;
use quad_tests::peers::has_egl;
use quad_tests::process::{assert_refused, binary, stdout};
use quad_tests::setting::Setting;
use quad_tests::small_disk::SmallDisk;
use quad_tests::system::Scratch;

const SETTING: Setting = Setting {
    steps: 40,
    eval_interval: 20,
    episodes: 2,
    candidates: 3,
    hidden: 16,
    seed: 5,
    online_steps: 0,
};

fn film(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(binary("evaluator"));
    command.current_dir(folder).arg("film").args(arguments);
    command
}

/// A finished run with scores.
fn run(scratch: &Scratch) -> Learner {
    let mut learner = scratch.learner("run", SETTING);
    let _evaluator = scratch.evaluator("evaluator", &learner.endpoint());
    learner.process.assert_succeeds(PATIENCE);
    learner
}

/// The colors of each frame of an animation: width × height × 4 bytes.
fn frames(path: &Path) -> ((u16, u16), Vec<Vec<u8>>) {
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(BufReader::new(File::open(path).unwrap())).unwrap();
    let size = (decoder.width(), decoder.height());
    let next = std::iter::from_fn(|| {
        decoder.read_next_frame().unwrap().map(|frame| frame.buffer.to_vec())
    });
    (size, next.collect())
}

#[test]
fn a_film_shows_the_episode_that_is_scored() {
    if !has_egl() {
        return;
    }
    let scratch = Scratch::new();
    let learner = run(&scratch);
    let folder = scratch.path();
    let (first, last) = (learner.snapshot(20), learner.snapshot(40));
    let [first, last] = [&first, &last].map(|path| path.to_str().unwrap());
    let score = learner.scores().into_iter().find(|score| score.step == 40).unwrap();
    let seed = score.seed.to_string();

    let printed = stdout(&film(folder, &[last, "--seed", &seed]).output().unwrap());
    let (length, episode_return) = (u64::from(score.length), score.episode_return);
    let words = format!(
        "seed {seed}, {length} steps, return {episode_return:.2}, {} candidates",
        SETTING.candidates
    );
    assert!(printed.contains(&words), "{words:?} is not in {printed:?}");
    let (size, frames) = frames(&folder.join("film.gif"));
    assert_eq!(size, (320, 240));
    assert_eq!(
        frames.len() as u64,
        length.div_ceil(5) + 1,
        "25 a second, of steps of 0.008 s, and the last"
    );
    let colors = |frame: &[u8]| {
        frame.chunks(4).map(<[u8]>::to_vec).collect::<std::collections::BTreeSet<_>>().len()
    };
    assert!(frames.iter().all(|frame| colors(frame) > 10), "each shows something");
    assert_ne!(frames.first(), frames.last());

    let run = first.split_once("/snapshots").unwrap().0;
    let flags = [run, "--step", "20", "--compare", last, "--out", "two.png"];
    let printed = stdout(&film(folder, &flags).output().unwrap());
    let seeds: Vec<&str> =
        printed.lines().filter_map(|line| line.split_once("seed ")?.1.split(',').next()).collect();
    assert!(seeds.len() == 2 && seeds[0] == seeds[1], "two episodes of one seed: {printed}");
    let mut picture =
        png::Decoder::new(BufReader::new(File::open(folder.join("two.png")).unwrap()))
            .read_info()
            .unwrap();
    let mut pixels = vec![0; picture.output_buffer_size().unwrap()];
    let info = picture.next_frame(&mut pixels).unwrap();
    assert_eq!((info.width, info.height), (8 * 240, 2 * 240));
    let part = |column: usize, row: usize| -> Vec<u8> {
        let rows = pixels.chunks(3 * 8 * 240).skip(240 * row).take(240);
        rows.flat_map(|line| &line[3 * 240 * column..3 * 240 * (column + 1)]).copied().collect()
    };
    assert!(part(0, 0) != part(7, 0) && part(0, 1) != part(7, 1), "they move");
    assert!(part(7, 0) != part(7, 1), "the two do not do the same");
}

/// An ffmpeg that writes what it is fed to the file that it is told, by a name that means no option
/// and no protocol.
const FFMPEG: &str = "#!/bin/sh\nfor last; do :; done\ncat > \"${last#file:}\" && [ \"$last\" != \"${last#file:}\" ]\n";

#[test]
fn a_film_is_whole_or_absent() {
    if !has_egl() {
        return;
    }
    let scratch = Scratch::new();
    let learner = run(&scratch);
    let (folder, snapshot) = (scratch.path(), learner.snapshot(40));
    let snapshot = snapshot.to_str().unwrap();
    fs::create_dir(folder.join("a:b")).unwrap();
    let ffmpeg = folder.join("ffmpeg");
    fs::write(&ffmpeg, FFMPEG).unwrap();
    fs::set_permissions(&ffmpeg, Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap());
    for name in ["-y.mp4", "a:b/x.mp4"] {
        let out = format!("--out={name}");
        stdout(&film(folder, &[snapshot, &out]).env("PATH", &path).output().unwrap());
        assert!(
            fs::metadata(folder.join(name)).unwrap().len() > 480 * 360 * 3,
            "{name} has pictures"
        );
    }
    let output =
        film(folder, &[snapshot, "--out", "film.mp4"]).env("PATH", "/nowhere").output().unwrap();
    assert_refused(&output, "cannot start ffmpeg", "--out film.gif");
    fs::write(&ffmpeg, "#!/bin/sh\nexit 3\n").unwrap();
    let output =
        film(folder, &[snapshot, "--out", "film.mp4"]).env("PATH", &path).output().unwrap();
    assert_refused(&output, "ffmpeg ended with exit status: 3", "--out film.gif");
    assert!(!folder.join("film.mp4").exists());

    let Some(disk) = SmallDisk::mount(&folder.join("disk"), 1) else { return };
    disk.fill();
    for name in ["disk/film.gif", "disk/film.png"] {
        let output = film(folder, &[snapshot, "--out", name]).output().unwrap();
        assert_refused(&output, &format!("cannot write {name}"), "enough space");
        assert_eq!(
            fs::read_dir(folder.join("disk")).unwrap().count(),
            1,
            "something is left of {name}"
        );
    }
}
