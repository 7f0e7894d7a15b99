//! The file of a film: an animation, a video or a strip, and the layout of its pictures.

use std::ffi::OsStr;
use std::io::Write;
use std::iter::once;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context, anyhow};
use color_quant::NeuQuant;
use gif::{Encoder, Frame, Repeat};
use quad_run::files;
use quad_run::folder::{RunDir, RunDirError};
use quad_runtime::Hint;

/// Pictures of a strip.
const STRIP: usize = 8;
/// Colors of an animation; fewer colors make a smaller file.
const COLORS: usize = 64;
/// Sampling of the first picture to choose colors: 1 is all of it, 10 a tenth.
const SAMPLE: i32 = 10;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// An animation, which this program encodes.
    Gif,
    /// A video, which ffmpeg encodes.
    Mp4,
    /// A strip: a few pictures side by side.
    Png,
}

#[derive(Clone, Debug)]
pub struct Output {
    pub path: PathBuf,
    pub format: Format,
}

/// Parses the name of a file.
pub fn output(name: &str) -> Result<Output, String> {
    let path = PathBuf::from(name);
    let format = match path.extension().and_then(OsStr::to_str) {
        Some("gif") => Format::Gif,
        Some("mp4") => Format::Mp4,
        Some("png") => Format::Png,
        _ => return Err("its name must end with .gif, .mp4 or .png".to_owned()),
    };
    Ok(Output { path, format })
}

impl Format {
    /// Width and height of one episode's view, pixels.
    fn view_size(self) -> (usize, usize) {
        match self {
            Self::Gif => (320, 240),
            Self::Mp4 => (480, 360),
            Self::Png => (240, 240),
        }
    }

    /// Width over height of one episode's view.
    pub fn aspect(self) -> f64 {
        let (width, height) = self.view_size();
        width as f64 / height as f64
    }

    /// Width and height of a picture of several episodes, pixels: side by side, in a strip stacked.
    pub fn size(self, episodes: usize) -> (usize, usize) {
        let (width, height) = self.view_size();
        match self {
            Self::Png => (width, height * episodes),
            _ => (width * episodes, height),
        }
    }

    /// Left, bottom, width and height of the view of the episode with this index, pixels.
    pub fn view(self, index: usize, episodes: usize) -> [usize; 4] {
        let (width, height) = self.view_size();
        match self {
            Self::Png => [0, (episodes - 1 - index) * height, width, height],
            _ => [index * width, 0, width, height],
        }
    }

    /// The steps of an episode of `last` steps after which a picture is taken: about 25 a second, and
    /// the last one; in a strip eight.
    pub fn steps(self, last: usize, control_period: f64) -> Vec<usize> {
        match self {
            Self::Png => (0..STRIP).map(|picture| picture * last / (STRIP - 1)).collect(),
            _ => (0..last).step_by(stride(control_period)).chain([last]).collect(),
        }
    }
}

/// Steps from one picture of a film to the next.
pub fn stride(control_period: f64) -> usize {
    ((0.04 / control_period).round() as usize).max(1)
}

pub struct Picture {
    pub width: usize,
    /// [height, width, 3], from the top left
    pub rgb: Vec<u8>,
}

impl Picture {
    fn height(&self) -> usize {
        self.rgb.len() / (3 * self.width)
    }
}

/// Writes pictures, each shown for `seconds`. The file gets its name when it is whole; after an
/// error, an earlier file stays.
pub fn write(
    output: &Output,
    seconds: f64,
    pictures: impl Iterator<Item = anyhow::Result<Picture>>,
) -> anyhow::Result<()> {
    let mut undrawn = Ok(());
    let drawn = pictures.map_while(|picture| picture.map_err(|error| undrawn = Err(error)).ok());
    let film = match output.format {
        Format::Gif => animation(seconds, drawn),
        Format::Mp4 => video(seconds, drawn),
        Format::Png => strip(drawn),
    };
    undrawn?;
    RunDir::refuse_own_file(&output.path).hint_of(RunDirError::hint)?;
    film.and_then(|film| Ok(files::replace(&output.path, &film)?))
        .with_context(|| format!("cannot write {}", output.path.display()))
        .hint("choose a file with --out in a folder that you may write to, with enough space")
}

/// Pictures side by side.
fn strip(pictures: impl Iterator<Item = Picture>) -> anyhow::Result<Vec<u8>> {
    let pictures: Vec<_> = pictures.collect();
    let height = pictures.first().context("there are no pictures")?.height();
    let width: usize = pictures.iter().map(|picture| picture.width).sum();
    let rows = (0..height).flat_map(|row| {
        pictures
            .iter()
            .flat_map(move |picture| &picture.rgb[3 * picture.width * row..][..3 * picture.width])
    });
    let rgb = Vec::from_iter(rows.copied());
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&rgb)?;
    writer.finish()?;
    Ok(file)
}

/// All pictures have the colors of the first: with a palette for each picture, the floor would
/// flicker.
fn animation(seconds: f64, mut pictures: impl Iterator<Item = Picture>) -> anyhow::Result<Vec<u8>> {
    let first = pictures.next().context("there are no pictures")?;
    let (width, height) = (first.width as u16, first.height() as u16);
    let opaque = |rgb: &[u8]| [rgb[0], rgb[1], rgb[2], 255];
    let rgba: Vec<u8> = first.rgb.chunks_exact(3).flat_map(opaque).collect();
    let colors = NeuQuant::new(SAMPLE, COLORS, &rgba);
    let nearest = |rgb: &[u8]| colors.index_of(&opaque(rgb)) as u8;
    let mut encoder = Encoder::new(Vec::new(), width, height, &colors.color_map_rgb())?;
    encoder.set_repeat(Repeat::Infinite)?;
    for picture in once(first).chain(pictures) {
        let pixels: Vec<u8> = picture.rgb.chunks_exact(3).map(nearest).collect();
        let mut frame = Frame::from_indexed_pixels(width, height, pixels, None);
        frame.delay = (100.0 * seconds).round() as u16;
        encoder.write_frame(&frame)?;
    }
    Ok(encoder.into_inner()?)
}

fn video(seconds: f64, mut pictures: impl Iterator<Item = Picture>) -> anyhow::Result<Vec<u8>> {
    let first = pictures.next().context("there are no pictures")?;
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("film.mp4");
    let size = format!("{}x{}", first.width, first.height());
    let mut ffmpeg = Command::new("ffmpeg")
        .args(["-loglevel", "error", "-nostdin", "-y", "-f", "rawvideo", "-pixel_format", "rgb24"])
        .args(["-video_size", &size, "-framerate", &(1.0 / seconds).to_string(), "-i", "pipe:0"])
        .args(["-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"])
        // Without this, ffmpeg takes a path that begins with - for an option, and one with a colon
        // for a protocol.
        .arg([OsStr::new("file:"), path.as_os_str()].join(OsStr::new("")))
        .stdin(Stdio::piped())
        .spawn()
        .context("cannot start ffmpeg")
        .hint("apt-get install --no-install-recommends ffmpeg, or use --out film.gif, which needs no other program")?;
    if let Some(mut pipe) = ffmpeg.stdin.take() {
        for picture in once(first).chain(pictures) {
            // If ffmpeg has ended, its message says why.
            if pipe.write_all(&picture.rgb).is_err() {
                break;
            }
        }
    }
    let status = ffmpeg.wait()?;
    if !status.success() {
        return Err(anyhow!("ffmpeg ended with {status}"))
            .hint("its message is above; --out film.gif needs no other program");
    }
    Ok(files::read(&path)?)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use anyhow::bail;

    use super::*;

    #[test]
    fn films_lie_side_by_side_and_strips_one_below_the_other() {
        let (film, strip) = (Format::Gif, Format::Png);
        assert_eq!((film.size(2), strip.size(2)), ((640, 240), (240, 480)));
        let views = |format: Format| [format.view(0, 2), format.view(1, 2)];
        assert_eq!(views(film), [[0, 0, 320, 240], [320, 0, 320, 240]]);
        assert_eq!(views(strip), [[0, 240, 240, 240], [0, 0, 240, 240]]);
        assert_eq!(film.steps(12, 0.008), [0, 5, 10, 12]);
        assert_eq!(film.steps(2, 0.1), [0, 1, 2]);
        assert_eq!(strip.steps(14, 0.008), [0, 2, 4, 6, 8, 10, 12, 14]);
    }

    /// Nine pictures of one color each, of which the one with number `broken` cannot be drawn.
    fn pictures(broken: u8) -> impl Iterator<Item = anyhow::Result<Picture>> {
        (0..9).map(move |number| match number == broken {
            true => bail!("no light"),
            false => Ok(Picture { width: 64, rgb: vec![20 * number; 3 * 64 * 48] }),
        })
    }

    #[test]
    fn a_film_gets_its_name_when_it_is_whole() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["film.gif", "film.png"] {
            let output = output(folder.path().join(name).to_str().unwrap()).unwrap();
            let unnamed = pictures(9).inspect(|_| assert!(!output.path.exists(), "{name}"));
            write(&output, 0.04, unnamed).unwrap();
            let whole = fs::read(&output.path).unwrap();
            for broken in [0, 5] {
                let error = write(&output, 0.04, pictures(broken)).unwrap_err();
                // Nothing is wrong with the file.
                assert_eq!(format!("{error:#}"), "no light");
                assert!(fs::read(&output.path).unwrap() == whole, "{name}");
            }
            fs::remove_file(&output.path).unwrap();
            let left = fs::read_dir(folder.path()).unwrap().count();
            assert_eq!(left, 0, "something is left of {name}");
        }
    }
}
