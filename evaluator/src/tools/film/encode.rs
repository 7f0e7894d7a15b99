//! Writes pictures to a file: an animation, a video or a strip.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::iter::once;
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, bail};
use color_quant::NeuQuant;
use gif::{Encoder, Frame, Repeat};
use quad_runtime::Hint;

use super::output::{Format, Output};
use super::picture::Picture;

/// Colours of an animation; fewer colours make a smaller file.
const COLOURS: usize = 64;
/// Sampling of the first picture to choose colours: 1 is all of it, 10 a tenth.
const SAMPLE: i32 = 10;

/// Writes pictures, each shown for `seconds`.
///
/// # Errors
/// A picture cannot be drawn, or the file cannot be written.
pub fn write(
    output: &Output,
    seconds: f64,
    pictures: impl Iterator<Item = anyhow::Result<Picture>>,
) -> anyhow::Result<()> {
    let path = &output.path;
    match output.format {
        Format::Gif => animation(path, seconds, pictures),
        Format::Mp4 => video(path, seconds, pictures),
        Format::Png => strip(path, pictures),
    }
    .with_context(|| format!("cannot write {}", path.display()))
    .hint("--out names a file in a folder that you may write in")
}

fn strip(path: &Path, pictures: impl Iterator<Item = anyhow::Result<Picture>>) -> anyhow::Result<()> {
    let strip = Picture::strip(&pictures.collect::<anyhow::Result<Vec<_>>>()?);
    let file = BufWriter::new(File::create(path)?);
    let mut encoder = png::Encoder::new(file, strip.width as u32, strip.height() as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&strip.rgb)?;
    Ok(writer.finish()?)
}

/// All pictures have the colours of the first: with a palette for each picture, the floor would flicker.
fn animation(
    path: &Path,
    seconds: f64,
    mut pictures: impl Iterator<Item = anyhow::Result<Picture>>,
) -> anyhow::Result<()> {
    let first = pictures.next().context("there is no picture")??;
    let (width, height) = (first.width as u16, first.height() as u16);
    let rgba: Vec<u8> = first.rgb.chunks_exact(3).flat_map(|rgb| [rgb[0], rgb[1], rgb[2], 255]).collect();
    let colours = NeuQuant::new(SAMPLE, COLOURS, &rgba);
    let nearest = |rgb: &[u8]| colours.index_of(&[rgb[0], rgb[1], rgb[2], 255]) as u8;
    let file = BufWriter::new(File::create(path)?);
    let mut encoder = Encoder::new(file, width, height, &colours.color_map_rgb())?;
    encoder.set_repeat(Repeat::Infinite)?;
    for picture in once(Ok(first)).chain(pictures) {
        let pixels: Vec<u8> = picture?.rgb.chunks_exact(3).map(nearest).collect();
        let frame = Frame::from_indexed_pixels(width, height, pixels, None);
        encoder.write_frame(&Frame { delay: (100.0 * seconds).round() as u16, ..frame })?;
    }
    encoder.into_inner()?.flush()?;
    Ok(())
}

fn video(path: &Path, seconds: f64, mut pictures: impl Iterator<Item = anyhow::Result<Picture>>) -> anyhow::Result<()> {
    let first = pictures.next().context("there is no picture")??;
    let size = format!("{}x{}", first.width, first.height());
    let mut ffmpeg = Command::new("ffmpeg")
        .args(["-loglevel", "error", "-nostdin", "-y", "-f", "rawvideo", "-pixel_format", "rgb24"])
        .args(["-video_size", &size, "-framerate", &(1.0 / seconds).to_string(), "-i", "pipe:0"])
        .args(["-pix_fmt", "yuv420p", "-movflags", "+faststart"])
        .arg(path)
        .stdin(Stdio::piped())
        .spawn()
        .context("ffmpeg cannot be started")
        .hint("apt-get install --no-install-recommends ffmpeg, or --out film.gif, which needs nothing")?;
    if let Some(mut pipe) = ffmpeg.stdin.take() {
        for picture in once(Ok(first)).chain(pictures) {
            // If ffmpeg has ended, its message says why.
            if pipe.write_all(&picture?.rgb).is_err() {
                break;
            }
        }
    }
    let status = ffmpeg.wait()?;
    if !status.success() {
        bail!("ffmpeg ended with {status}");
    }
    Ok(())
}
