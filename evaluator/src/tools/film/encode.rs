//! Writes pictures to a file: an animation, a video or a strip.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, bail};
use color_quant::NeuQuant;
use gif::{Encoder, Frame, Repeat};
use quad_service::Hint;

use super::output::{Format, Output};
use super::picture::Picture;

/// Colours of an animation; the fewer, the smaller it is.
const COLOURS: usize = 64;
/// How much of the first picture its colours are chosen from: all of it is 1, a tenth 10.
const SAMPLE: i32 = 10;

/// Writes pictures, each to be shown for so many seconds.
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

/// The colours are those of the first picture: with colours of its own for each, the floor would flicker.
fn animation(path: &Path, seconds: f64, pictures: impl Iterator<Item = anyhow::Result<Picture>>) -> anyhow::Result<()> {
    let mut pictures = pictures.peekable();
    let Some(Ok(first)) = pictures.peek() else { return pictures.try_for_each(|picture| picture.map(drop)) };
    let (width, height) = (first.width as u16, first.height() as u16);
    let rgba: Vec<u8> = first.rgb.chunks_exact(3).flat_map(|rgb| [rgb[0], rgb[1], rgb[2], 255]).collect();
    let colours = NeuQuant::new(SAMPLE, COLOURS, &rgba);
    let nearest = nearest(&colours);
    let file = BufWriter::new(File::create(path)?);
    let mut encoder = Encoder::new(file, width, height, &colours.color_map_rgb())?;
    encoder.set_repeat(Repeat::Infinite)?;
    for picture in pictures {
        let pixels: Vec<u8> = picture?.rgb.chunks_exact(3).map(|rgb| nearest[cell(rgb)]).collect();
        let frame = Frame::from_indexed_pixels(width, height, pixels, None);
        encoder.write_frame(&Frame { delay: (100.0 * seconds).round() as u16, ..frame })?;
    }
    encoder.into_inner()?.flush()?;
    Ok(())
}

/// The cell of a colour in a cube of 32 × 32 × 32.
fn cell(rgb: &[u8]) -> usize {
    rgb.iter().fold(0, |cell, &value| cell * 32 + usize::from(value / 8))
}

/// The nearest of `colours` to the middle of each cell: to search them for each pixel takes longer than to draw it.
fn nearest(colours: &NeuQuant) -> Vec<u8> {
    let middle = |cell: usize| [cell / 1024, cell / 32 % 32, cell % 32].map(|value| (8 * value + 4) as u8);
    let cells = (0..32 * 32 * 32).map(middle);
    cells.map(|[red, green, blue]| colours.index_of(&[red, green, blue, 255]) as u8).collect()
}

fn video(path: &Path, seconds: f64, pictures: impl Iterator<Item = anyhow::Result<Picture>>) -> anyhow::Result<()> {
    let mut pictures = pictures.peekable();
    let Some(Ok(first)) = pictures.peek() else { return pictures.try_for_each(|picture| picture.map(drop)) };
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
        for picture in pictures {
            // If ffmpeg has ended, it says why.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_colour_is_replaced_by_the_nearest_of_those_that_are_kept() {
        let shades: Vec<u8> = (0..=255).flat_map(|shade| [shade, shade / 2, 0, 255]).collect();
        let colours = NeuQuant::new(1, COLOURS, &shades.repeat(16));
        let (nearest, kept) = (nearest(&colours), colours.color_map_rgb());
        for shade in shades.chunks_exact(4) {
            let found = usize::from(nearest[cell(&shade[..3])]);
            let error = (0..3).map(|i| shade[i].abs_diff(kept[3 * found + i])).max().unwrap();
            assert!(error <= 16, "{shade:?} becomes {:?}", &kept[3 * found..3 * found + 3]);
        }
    }
}
