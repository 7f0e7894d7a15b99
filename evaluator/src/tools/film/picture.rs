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
        let rows = 0..pictures.first().map_or(0, Self::height);
        let row = |row| pictures.iter().flat_map(move |picture| picture.row(row));
        let width = pictures.iter().map(|picture| picture.width).sum();
        let rgb = rows.flat_map(row).copied().collect();
        Self { width, rgb }
    }

    fn row(&self, row: usize) -> &[u8] {
        &self.rgb[3 * self.width * row..3 * self.width * (row + 1)]
    }

    /// Reverses the rows: OpenGL's begin at the bottom.
    pub fn flipped(self) -> Self {
        let rows = self.rgb.chunks_exact(3 * self.width).rev();
        let rgb = rows.flatten().copied().collect();
        Self { rgb, ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_strip_has_its_pictures_side_by_side() {
        let picture = |width, pixels: &[u8]| {
            let rgb = pixels.iter().flat_map(|&pixel| [pixel; 3]).collect();
            Picture { width, rgb }
        };
        let one = picture(1, &[1, 2]);
        let strip = Picture::strip(&[one.clone(), picture(2, &[3, 4, 5, 6])]);
        assert_eq!(strip, picture(3, &[1, 3, 4, 2, 5, 6]));
        assert_eq!(one.flipped(), picture(1, &[2, 1]));
    }
}
