//! The file of a film: its kind, and the layout of its pictures.

use std::path::PathBuf;

/// Pictures of a strip.
const STRIP: usize = 8;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// An animation, which this program encodes.
    Gif,
    /// A video, which ffmpeg encodes.
    Mp4,
    /// A strip: a few pictures side by side.
    Png,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Output {
    pub path: PathBuf,
    pub format: Format,
}

/// Parses the name of a file.
pub fn output(name: &str) -> Result<Output, String> {
    let path = PathBuf::from(name);
    let format = match path.extension().and_then(|extension| extension.to_str()) {
        Some("gif") => Format::Gif,
        Some("mp4") => Format::Mp4,
        Some("png") => Format::Png,
        _ => return Err("its name must end with .gif, .mp4 or .png".to_owned()),
    };
    Ok(Output { path, format })
}

/// Division of a picture among several episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Width and height of one episode's part, pixels.
    view: (usize, usize),
    /// One below the other, not side by side.
    stacked: bool,
}

impl Layout {
    pub fn of(format: Format) -> Self {
        let view = match format {
            Format::Gif => (320, 240),
            Format::Mp4 => (480, 360),
            Format::Png => (240, 240),
        };
        Self { view, stacked: format == Format::Png }
    }

    /// Width over height of one episode's part.
    pub fn aspect(self) -> f64 {
        self.view.0 as f64 / self.view.1 as f64
    }

    /// Width and height of the picture of several episodes, pixels.
    pub fn size(self, episodes: usize) -> (usize, usize) {
        let (width, height) = self.view;
        if self.stacked { (width, height * episodes) } else { (width * episodes, height) }
    }

    /// Left, bottom, width and height of the part of the episode with this index, pixels.
    pub fn view(self, index: usize, episodes: usize) -> [usize; 4] {
        let (width, height) = self.view;
        match self.stacked {
            true => [0, (episodes - 1 - index) * height, width, height],
            false => [index * width, 0, width, height],
        }
    }
}

/// The steps of an episode of `last` steps after which a picture is taken: about 25 a second, and
/// the last one.
pub fn steps(format: Format, last: usize, control_period: f64) -> Vec<usize> {
    match format {
        Format::Png => (0..STRIP).map(|picture| picture * last / (STRIP - 1)).collect(),
        _ => (0..last).step_by(stride(control_period)).chain([last]).collect(),
    }
}

/// Steps from one picture of a film to the next.
pub fn stride(control_period: f64) -> usize {
    ((0.04 / control_period).round() as usize).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn films_lie_side_by_side_and_strips_one_below_the_other() {
        let (film, strip) = (Layout::of(Format::Gif), Layout::of(Format::Png));
        assert_eq!((film.size(2), strip.size(2)), ((640, 240), (240, 480)));
        let views = |layout: Layout| [layout.view(0, 2), layout.view(1, 2)];
        assert_eq!(views(film), [[0, 0, 320, 240], [320, 0, 320, 240]]);
        assert_eq!(views(strip), [[0, 240, 240, 240], [0, 0, 240, 240]]);
    }

    #[test]
    fn a_film_has_25_pictures_a_second_and_a_strip_eight_in_all() {
        assert_eq!(steps(Format::Gif, 12, 0.008), [0, 5, 10, 12]);
        assert_eq!(steps(Format::Mp4, 10, 0.008), [0, 5, 10]);
        assert_eq!(steps(Format::Gif, 2, 0.1), [0, 1, 2]);
        assert_eq!(steps(Format::Png, 14, 0.008), [0, 2, 4, 6, 8, 10, 12, 14]);
    }
}
