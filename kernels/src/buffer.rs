//! Reused memory.

/// Bytes of a cache line, and of the widest register.
const LINE: usize = 64;

/// Numbers aligned to a cache line, since registers across two lines cost two accesses. Grows, never
/// shrinks.
#[derive(Default)]
pub struct Buffer(Vec<f32>);

impl Buffer {
    /// `len` numbers, with the content of earlier use.
    pub fn sized(&mut self, len: usize) -> &mut [f32] {
        let needed = len + LINE / size_of::<f32>();
        if self.0.len() < needed {
            self.0 = vec![0.0; needed];
        }
        let start = self.0.as_ptr().align_offset(LINE);
        &mut self.0[start..][..len]
    }

    /// The first `len` numbers, at most as many as [`Self::sized`] was asked for.
    pub fn first(&self, len: usize) -> &[f32] {
        let start = self.0.as_ptr().align_offset(LINE);
        &self.0[start..][..len]
    }
}
