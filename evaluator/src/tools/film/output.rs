//! The file of a film: its kind, and the layout of its pictures.

use std::path::PathBuf;

/// Pictures of a strip.
pub const STRIP: usize = 8;

/// The kinds of files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// An animation, which this program encodes.
    Gif,
    /// A video, which ffmpeg encodes.
    Mp4,
    /// A few pictures side by side, as one picture.
    Png,
}

/// Where a film goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Output {
    /// The file.
    pub path: PathBuf,
    /// The kind that its name says.
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

/// How a picture is divided among several episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Width of one episode's part, pixels.
    width: usize,
    /// Height of one episode's part, pixels.
    height: usize,
    /// One below the other, not side by side.
    stacked: bool,
}

impl Layout {
    /// The layout for a kind of file.
    pub fn of(format: Format) -> Self {
        let (width, height) = match format {
            Format::Gif => (320, 240),
            Format::Mp4 => (480, 360),
            Format::Png => (240, 240),
        };
        Self { width, height, stacked: format == Format::Png }
    }

    /// Width over height of one episode's part.
    pub fn aspect(self) -> f64 {
        self.width as f64 / self.height as f64
    }

    /// Width and height of the picture of several episodes, pixels.
    pub fn size(self, episodes: usize) -> (usize, usize) {
        if self.stacked {
            (self.width, self.height * episodes)
        } else {
            (self.width * episodes, self.height)
        }
    }

    /// The part of the episode with this index: left, bottom, width and height, pixels.
    pub fn view(self, place: usize, episodes: usize) -> [usize; 4] {
        let (left, bottom) = if self.stacked {
            (0, (episodes - 1 - place) * self.height)
        } else {
            (place * self.width, 0)
        };
        [left, bottom, self.width, self.height]
    }
}

/// The steps after which a picture of an episode of `last` steps is taken: about 25 a second, and
/// the last one.
pub fn steps(format: Format, last: usize, control_period: f64) -> Vec<usize> {
    match format {
        Format::Png => (0..STRIP).map(|picture| picture * last / (STRIP - 1)).collect(),
        Format::Gif | Format::Mp4 => {
            let regular = (0..last).step_by(stride(control_period));
            regular.chain([last]).collect()
        }
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
        assert_eq!(film.size(2), (640, 240));
        assert_eq!([0, 1].map(|place| film.view(place, 2)), [[0, 0, 320, 240], [320, 0, 320, 240]]);
        assert_eq!(strip.size(2), (240, 480));
        assert_eq!(
            [0, 1].map(|place| strip.view(place, 2)),
            [[0, 240, 240, 240], [0, 0, 240, 240]]
        );
    }

    #[test]
    fn a_film_has_25_pictures_a_second_and_a_strip_eight_in_all() {
        assert_eq!(steps(Format::Gif, 12, 0.008), [0, 5, 10, 12]);
        assert_eq!(steps(Format::Mp4, 10, 0.008), [0, 5, 10]);
        assert_eq!(steps(Format::Gif, 2, 0.1), [0, 1, 2]);
        assert_eq!(steps(Format::Png, 14, 0.008), [0, 2, 4, 6, 8, 10, 12, 14]);
    }
}
