//! A picture in memory.

/// A picture: rows from the top, in them pixels from the left, of three bytes (red, green, blue)
/// each.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Pixels in a row.
    pub width: usize,
    /// width × height × 3 bytes
    pub rgb: Vec<u8>,
}

impl Picture {
    /// Rows.
    pub fn height(&self) -> usize {
        self.rgb.len() / (3 * self.width)
    }

    /// Joins pictures of one height in a row, from the left.
    pub fn strip(pictures: &[Self]) -> Self {
        let rows = pictures.iter().map(Self::height).max().unwrap_or(0);
        let row = |row: usize| pictures.iter().flat_map(move |picture| picture.row(row)).copied();
        let width = pictures.iter().map(|picture| picture.width).sum();
        Self { width, rgb: (0..rows).flat_map(row).collect() }
    }

    fn row(&self, row: usize) -> &[u8] {
        &self.rgb[3 * self.width * row..3 * self.width * (row + 1)]
    }

    /// Turns the picture upside down: OpenGL's order of rows.
    pub fn flipped(self) -> Self {
        let rgb = (0..self.height()).rev().flat_map(|row| self.row(row)).copied().collect();
        Self { rgb, ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_strip_has_its_pictures_side_by_side() {
        let one = Picture { width: 1, rgb: vec![1, 1, 1, 2, 2, 2] };
        let two = Picture { width: 2, rgb: vec![3, 3, 3, 4, 4, 4, 5, 5, 5, 6, 6, 6] };
        let strip = Picture::strip(&[one.clone(), two]);
        assert_eq!((strip.width, strip.height()), (3, 2));
        assert_eq!(strip.rgb, [1, 1, 1, 3, 3, 3, 4, 4, 4, 2, 2, 2, 5, 5, 5, 6, 6, 6]);
        assert_eq!(one.flipped().rgb, [2, 2, 2, 1, 1, 1]);
    }
}
