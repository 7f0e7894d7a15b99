//! The weights of a network: one flat vector, with named tensors in it.

use crate::error::NetworkError;
use crate::gradients::kept::KeptGradient;
use crate::slices::{has_fast_implementation, modify};
use candle_core::{DType, Device, Result, Tensor, Var};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Tensors by name.
pub type Tensors = BTreeMap<String, Tensor>;

/// What a tensor's numbers are before training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    /// All the same.
    Constant(f32),
    /// Uniform within ± this.
    Uniform(f32),
    /// This times matrices with orthonormal rows or columns, whichever are fewer.
    Orthogonal(f32),
}

/// A named tensor in a flat vector.
#[derive(Clone, Debug)]
pub struct TensorSpec {
    /// Its name within the network, e.g. `trunk.0.kernel`.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// What it begins with.
    pub start: Init,
}

impl TensorSpec {
    fn count(&self) -> usize {
        self.shape.iter().product()
    }

    fn fill(&self, values: &mut [f32], generator: &mut impl Rng) {
        match (self.start, &self.shape[..]) {
            (Init::Constant(value), _) => values.fill(value),
            (Init::Uniform(bound), _) => values.fill_with(|| generator.random_range(-bound..bound)),
            (Init::Orthogonal(gain), [.., rows, columns]) => {
                values.chunks_exact_mut(rows * columns).for_each(|matrix| {
                    orthogonal(matrix, (*rows, *columns), generator);
                    matrix.iter_mut().for_each(|x| *x *= gain);
                });
            }
            (Init::Orthogonal(gain), _) => values.fill(gain),
        }
    }
}

/// Fills a matrix with orthonormal columns, or rows if these are fewer: normal numbers,
/// orthogonalized one after the other.
fn orthogonal(matrix: &mut [f32], (rows, columns): (usize, usize), generator: &mut impl Rng) {
    let (count, length) = (rows.min(columns), rows.max(columns));
    let mut vectors: Vec<Vec<f64>> = Vec::with_capacity(count);
    while vectors.len() < count {
        let mut vector: Vec<f64> = (0..length).map(|_| StandardNormal.sample(generator)).collect();
        for other in &vectors {
            let along: f64 = vector.iter().zip(other).map(|(x, y)| x * y).sum();
            vector.iter_mut().zip(other).for_each(|(x, y)| *x -= along * y);
        }
        let size = vector.iter().map(|x| x * x).sum::<f64>().sqrt();
        // A vector that hardly stands out of the others is drawn again: its direction would be
        // rounding.
        if size > 1e-3 {
            vector.iter_mut().for_each(|x| *x /= size);
            vectors.push(vector);
        }
    }
    for (i, x) in matrix.iter_mut().enumerate() {
        let (row, column) = (i / columns, i % columns);
        *x = if columns <= rows { vectors[column][row] } else { vectors[row][column] } as f32;
    }
}

/// The named tensors of a network, in the order in which they follow one another in its vector,
/// without gaps.
#[derive(Clone, Debug)]
pub struct Layout(Arc<[TensorSpec]>);

impl Layout {
    /// The layout of these parts.
    pub fn new(parts: Vec<TensorSpec>) -> Self {
        Self(parts.into())
    }

    /// Its parts.
    pub(crate) fn parts(&self) -> &[TensorSpec] {
        &self.0
    }

    /// Numbers in the vector.
    pub fn count(&self) -> usize {
        self.0.iter().map(TensorSpec::count).sum()
    }

    /// The tensors in a vector of this layout, as views of it, named with `prefix` before each
    /// name.
    pub fn split(&self, vector: &Tensor, prefix: &str) -> Result<Tensors> {
        let mut offset = 0;
        let view = |part: &TensorSpec| {
            let tensor = vector.narrow(0, offset, part.count())?.reshape(part.shape.as_slice())?;
            offset += part.count();
            Ok((format!("{prefix}{}", part.name), tensor))
        };
        self.0.iter().map(view).collect()
    }

    /// Puts a vector together of the tensors that [`Self::split`] names, and takes them out of
    /// `tensors`.
    ///
    /// # Errors
    /// One that is missing, or has another type or shape, or a number that is not finite.
    pub fn join(
        &self,
        tensors: &mut Tensors,
        prefix: &str,
    ) -> std::result::Result<Tensor, NetworkError> {
        let mut flat = Vec::with_capacity(self.0.len());
        for part in self.0.iter() {
            let tensor = take(tensors, format!("{prefix}{}", part.name), &part.shape)?;
            flat.push(tensor.flatten_all()?);
        }
        Ok(Tensor::cat(&flat, 0)?)
    }
}

/// Takes a tensor of that name and shape out of `tensors`.
///
/// # Errors
/// It is missing, or has another type or shape, or a number that is not finite.
pub fn take(
    tensors: &mut Tensors,
    name: String,
    shape: &[usize],
) -> std::result::Result<Tensor, NetworkError> {
    let Some(tensor) = tensors.remove(&name) else { return Err(NetworkError::Missing(name)) };
    let [found, expected] =
        [(tensor.dtype(), tensor.dims()), (DType::F32, shape)].map(|form| format!("{form:?}"));
    if found != expected {
        return Err(NetworkError::Shape { name, found, expected });
    }
    check_finite(&name, &tensor)?;
    Ok(tensor)
}

/// Checks that a tensor holds neither a NaN nor an infinity.
pub fn check_finite(name: &str, tensor: &Tensor) -> std::result::Result<(), NetworkError> {
    let numbers = tensor.flatten_all()?.to_vec1::<f32>()?;
    if numbers.iter().all(|x| x.is_finite()) {
        Ok(())
    } else {
        Err(NetworkError::NotFinite(name.to_owned()))
    }
}

/// Weights of one network, as a vector on one of candle's devices.
#[derive(Debug)]
pub struct Weights {
    layout: Layout,
    values: Tensor,
    kept: Option<Arc<KeptGradient>>,
}

impl Weights {
    /// Weights that gradients are taken of: a variable of candle's.
    pub fn trainable(layout: Layout, values: &Tensor) -> Result<Self> {
        let values = Var::from_tensor(values)?.into_inner();
        let kept = if has_fast_implementation(values.device()) {
            Some(Arc::new(KeptGradient::new(&values)?))
        } else {
            None
        };
        Ok(Self { layout, values, kept })
    }

    /// Weights that no gradient is taken of.
    pub fn constant(layout: Layout, values: Tensor) -> Self {
        Self { layout, values, kept: None }
    }

    /// Joins named tensors, which it takes out of `tensors`, into one vector of variables.
    ///
    /// # Errors
    /// As [`Layout::join`].
    pub fn take(
        layout: Layout,
        tensors: &mut Tensors,
        prefix: &str,
    ) -> std::result::Result<Self, NetworkError> {
        let values = layout.join(tensors, prefix)?;
        Ok(Self::constant(layout, values))
    }

    /// A constant copy.
    pub fn copy(&self) -> Result<Self> {
        Ok(Self::constant(self.layout.clone(), self.values.detach().copy()?))
    }

    /// Makes a constant of the vector; it changes with this one.
    pub fn detach(&self) -> Self {
        Self { kept: None, layout: self.layout.clone(), values: self.values.detach() }
    }

    /// What each part begins with.
    pub fn initial(layout: &Layout, generator: &mut impl Rng, device: &Device) -> Result<Tensor> {
        let mut values = vec![0.0; layout.count()];
        let mut rest = &mut values[..];
        for part in layout.0.iter() {
            let mine = rest.split_off_mut(..part.count()).unwrap_or_default();
            part.fill(mine, generator);
        }
        Tensor::from_vec(values, layout.count(), device)
    }

    /// The vector.
    pub fn values(&self) -> &Tensor {
        &self.values
    }

    /// What lies where in the vector.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The named tensors, as views of the vector.
    pub fn tensors(&self, prefix: &str) -> Result<Tensors> {
        self.layout.split(&self.values.detach(), prefix)
    }

    /// Takes the values of named tensors, and takes these out of `tensors`.
    ///
    /// # Errors
    /// As [`Layout::join`].
    pub fn load(
        &mut self,
        tensors: &mut Tensors,
        prefix: &str,
    ) -> std::result::Result<(), NetworkError> {
        let values = self.layout.join(tensors, prefix)?.to_device(self.values.device())?;
        Ok(self.change(|mine| mine.slice_set(&values, 0, 0))?)
    }

    /// Changes the vector in place.
    pub fn change(&mut self, work: impl FnOnce(&Tensor) -> Result<()>) -> Result<()> {
        work(&self.values.detach())
    }

    /// Where the fast implementation leaves the gradient of these weights.
    pub(crate) fn kept_gradient(&self) -> Option<&Arc<KeptGradient>> {
        self.kept.as_ref()
    }

    /// The EMA update of a target network: `w = (1 - rate)·w + rate·online`.
    pub fn ema_update(&mut self, online: &Self, rate: f32) -> Result<()> {
        let online = online.values.detach();
        #[cfg(feature = "cuda")]
        if online.device().is_cuda() {
            return crate::gpu::tensors::read(&online, |online| {
                self.change(|mine| {
                    crate::gpu::tensors::modify(mine, |stream, mine| {
                        quad_kernels::cuda::ema(stream, mine, online, rate)
                            .map_err(candle_core::Error::wrap)
                    })
                })
            });
        }
        if has_fast_implementation(online.device()) {
            return crate::slices::read(&online, |online: &[f32]| {
                self.change(|mine| {
                    modify(mine, |mine| quad_kernels::optimizer::ema(mine, online, rate))
                })
            })?;
        }
        let (keep, take) = (1.0 - f64::from(rate), f64::from(rate));
        self.change(|mine| mine.slice_set(&((mine * keep)? + (online * take)?)?, 0, 0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn each_part_begins_with_what_it_says() {
        let part = |name: &str, shape: &[usize], start| TensorSpec {
            name: name.to_owned(),
            shape: shape.to_vec(),
            start,
        };
        let layout = Layout::new(vec![
            part("wide", &[2, 3, 5], Init::Orthogonal(2.0)),
            part("tall", &[1, 5, 3], Init::Orthogonal(2.0)),
            part("scale", &[4], Init::Constant(1.0)),
            part("flat", &[100], Init::Uniform(0.25)),
        ]);
        let values =
            Weights::initial(&layout, &mut ChaCha8Rng::seed_from_u64(0), &Device::Cpu).unwrap();
        let parts = layout.split(&values, "").unwrap();
        for (name, transposed) in [("wide", false), ("tall", true)] {
            for matrix in parts[name].to_vec3::<f32>().unwrap() {
                let matrix = Tensor::new(matrix, &Device::Cpu).unwrap();
                let rows = if transposed { matrix.t().unwrap() } else { matrix };
                let rows = rows.contiguous().unwrap();
                let products = rows.matmul(&rows.t().unwrap()).unwrap();
                let expected = (Tensor::eye(3, DType::F32, &Device::Cpu).unwrap() * 4.0).unwrap();
                let difference = (products - expected).unwrap().abs().unwrap().max_all().unwrap();
                assert!(difference.to_scalar::<f32>().unwrap() < 1e-5, "{name}");
            }
        }
        assert_eq!(parts["scale"].to_vec1::<f32>().unwrap(), [1.0; 4]);
        let flat = parts["flat"].to_vec1::<f32>().unwrap();
        assert!(flat.iter().all(|x| x.abs() < 0.25) && flat.iter().any(|x| x.abs() > 0.2));
    }
}
