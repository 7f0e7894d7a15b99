//! `evaluator film` shows the episode that is scored, in files that others read.

use std::collections::BTreeSet;
use std::fs::{self, File, Permissions};
use std::io::BufReader;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Output;

use quad_tests::disk::SmallDisk;
use quad_tests::peers::has_egl;
use quad_tests::process::{assert_refused, command, stdout};
use quad_tests::system::Scratch;

use crate::score::{SETTING, finished_run};

/// Films, with `path` to look for ffmpeg.
fn film(folder: &Path, line: &str, path: &str) -> Output {
    let mut film = command(&format!("evaluator film {line}"));
    film.current_dir(folder).env("PATH", path).output().unwrap()
}

/// Width and height, and each frame of an animation, 4 bytes a pixel.
fn frames(path: &Path) -> ((u16, u16), Vec<Vec<u8>>) {
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(BufReader::new(File::open(path).unwrap())).unwrap();
    let size = (decoder.width(), decoder.height());
    let mut frames = Vec::new();
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        assert_eq!(frame.delay, 4, "hundredths of a second");
        frames.push(frame.buffer.to_vec());
    }
    (size, frames)
}

/// Width and height, and the picture, 3 bytes a pixel.
fn picture(path: &Path) -> ((u32, u32), Vec<u8>) {
    let decoder = png::Decoder::new(BufReader::new(File::open(path).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    ((info.width, info.height), pixels)
}

#[test]
fn a_film_shows_the_episode_that_is_scored() {
    if !has_egl() {
        return;
    }
    let scratch = Scratch::new();
    let learner = finished_run(&scratch, "run", "f32", &[]);
    let folder = scratch.path();
    let score = learner.scores().into_iter().find(|score| score.step == 40).unwrap();
    let (seed, length) = (score.seed, u64::from(score.length));
    let last = learner.snapshot(40).display().to_string();
    let printed = stdout(&film(folder, &format!("{last} --seed {seed}"), ""));
    let (outcome, candidates) = (score.episode_return, SETTING.candidates);
    let words =
        format!("seed {seed}, {length} steps, return {outcome:.2}, {candidates} candidates");
    assert!(printed.contains(&words), "{words:?} is not in {printed:?}");
    let (size, frames) = frames(&folder.join("film.gif"));
    assert_eq!(size, (320, 240));
    // 25 a second, of steps of 0.008 s, and the last.
    assert_eq!(frames.len() as u64, length.div_ceil(5) + 1);
    let colors = |frame: &Vec<u8>| BTreeSet::from_iter(frame.chunks(4)).len();
    assert!(frames.iter().all(|frame| colors(frame) > 10), "each shows something");
    assert_ne!(frames.first(), frames.last());

    let printed =
        stdout(&film(folder, &format!("run --step 20 --compare {last} --out two.png"), ""));
    let seed = printed.split_once("seed ").unwrap().1.split(',').next().unwrap();
    assert_eq!(printed.matches(&format!("seed {seed},")).count(), 2, "{printed}");
    let (size, pixels) = picture(&folder.join("two.png"));
    assert_eq!(size, (8 * 240, 2 * 240));
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
    let learner = finished_run(&scratch, "run", "f32", &[]);
    let (folder, snapshot) = (scratch.path(), learner.snapshot(40).display().to_string());
    fs::create_dir(folder.join("a:b")).unwrap();
    let ffmpeg = folder.join("ffmpeg");
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap());
    let write_ffmpeg = |script: &str| {
        fs::write(&ffmpeg, script).unwrap();
        fs::set_permissions(&ffmpeg, Permissions::from_mode(0o755)).unwrap();
    };
    write_ffmpeg(FFMPEG);
    for name in ["-y.mp4", "a:b/x.mp4"] {
        stdout(&film(folder, &format!("{snapshot} --out={name}"), &path));
        let bytes = fs::metadata(folder.join(name)).unwrap().len();
        assert!(bytes > 480 * 360 * 3, "{name} has pictures");
    }
    write_ffmpeg("#!/bin/sh\nexit 3\n");
    for (path, sentence) in
        [("/nowhere", "cannot start ffmpeg"), (&path, "ffmpeg ended with exit status: 3")]
    {
        let output = film(folder, &format!("{snapshot} --out film.mp4"), path);
        assert_refused(&output, sentence, "--out film.gif");
        assert!(!folder.join("film.mp4").exists());
    }
    let Some(disk) = SmallDisk::mount(&folder.join("disk"), 1) else { return };
    disk.fill();
    for name in ["disk/film.gif", "disk/film.png"] {
        let output = film(folder, &format!("{snapshot} --out {name}"), "");
        assert_refused(&output, &format!("cannot write {name}"), "enough space");
        let files = fs::read_dir(folder.join("disk")).unwrap().count();
        assert_eq!(files, 1, "something is left of {name}");
    }
}
