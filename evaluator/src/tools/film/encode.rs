//! Writes pictures to a file: an animation, a video or a strip.

use std::ffi::OsStr;
use std::io::Write;
use std::iter::once;
use std::process::{Command, Stdio};

use anyhow::{Context, anyhow, bail};
use color_quant::NeuQuant;
use gif::{Encoder, Frame, Repeat};
use quad_run::files;
use quad_runtime::Hint;

use super::output::{Format, Output};
use super::picture::Picture;

/// Colors of an animation; fewer colors make a smaller file.
const COLORS: usize = 64;
/// Sampling of the first picture to choose colors: 1 is all of it, 10 a tenth.
const SAMPLE: i32 = 10;

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
    film.and_then(|film| Ok(files::replace(&output.path, &film)?))
        .with_context(|| format!("cannot write {}", output.path.display()))
        .hint("choose a file with --out in a folder that you may write to, with enough space")
}

fn strip(pictures: impl Iterator<Item = Picture>) -> anyhow::Result<Vec<u8>> {
    let pictures: Vec<_> = pictures.collect();
    if pictures.is_empty() {
        bail!("there are no pictures");
    }
    let strip = Picture::strip(&pictures);
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, strip.width as u32, strip.height() as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&strip.rgb)?;
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

    use super::*;

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
        for (name, format) in [("film.gif", Format::Gif), ("film.png", Format::Png)] {
            let path = folder.path().join(name);
            let output = Output { path, format };
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

    #[test]
    fn an_animation_shows_each_picture_for_its_time() {
        let film = animation(0.04, pictures(9).map(Result::unwrap)).unwrap();
        let (mut film, mut delays) = (gif::Decoder::new(&film[..]).unwrap(), Vec::new());
        while let Some(frame) = film.read_next_frame().unwrap() {
            delays.push(frame.delay);
        }
        // In hundredths of a second.
        assert_eq!(delays, [4; 9]);
    }
}
