//! A picture in memory.

#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    pub width: usize,
    /// [height, width, 3], from the top left
    pub rgb: Vec<u8>,
}

impl Picture {
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

    /// Reverses the rows: OpenGL's begin at the bottom.
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
