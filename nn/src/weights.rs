//! The weights of a network: one flat vector, with named tensors in it.

use crate::error::NetworkError;
use crate::gradients::buffer::GradientBuffer;
use crate::slices::{has_fast_implementation, modify, read};
use candle_core::{DType, Device, Result, Tensor, Var};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Tensors by name.
pub type Tensors = BTreeMap<String, Tensor>;

/// Initial values of a tensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    /// This number.
    Constant(f32),
    /// U(−b, b) for this b.
    Uniform(f32),
    /// This gain times matrices with orthonormal rows or columns, whichever are fewer.
    Orthogonal(f32),
}

/// A tensor in a flat vector, its name within the network (e.g. `trunk.0.kernel`) and initial values.
#[derive(Clone, Debug)]
#[allow(missing_docs)] // See above.
pub struct TensorSpec {
    pub name: String,
    pub shape: Vec<usize>,
    pub init: Init,
}

impl TensorSpec {
    /// A tensor with this name, shape and initial values.
    pub fn new(name: String, shape: &[usize], init: Init) -> Self {
        Self { name, shape: shape.to_vec(), init }
    }

    pub(crate) fn count(&self) -> usize {
        self.shape.iter().product()
    }

    fn fill(&self, values: &mut [f32], generator: &mut impl Rng) {
        match (self.init, &self.shape[..]) {
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
            let numbers = vector.iter_mut().zip(other);
            numbers.for_each(|(x, y)| *x -= along * y);
        }
        let size = vector.iter().map(|x| x * x).sum::<f64>().sqrt();
        // A vector nearly in the span of the others is drawn again: its rest is rounding error.
        if size > 1e-3 {
            vector.iter_mut().for_each(|x| *x /= size);
            vectors.push(vector);
        }
    }
    for (i, x) in matrix.iter_mut().enumerate() {
        let (row, column) = (i / columns, i % columns);
        let number = match columns <= rows {
            true => vectors[column][row],
            false => vectors[row][column],
        };
        *x = number as f32;
    }
}

/// The named tensors of a network in the order of its vector, without gaps.
#[derive(Clone, Debug)]
pub struct Layout(Arc<[TensorSpec]>);

impl Layout {
    /// The layout of these tensors.
    pub fn new(specs: Vec<TensorSpec>) -> Self {
        Self(specs.into())
    }

    pub(crate) fn specs(&self) -> &[TensorSpec] {
        &self.0
    }

    /// Numbers in the vector, P.
    pub fn count(&self) -> usize {
        self.0.iter().map(TensorSpec::count).sum()
    }

    /// Views of the tensors in a vector of this layout, named `{prefix}{name}`.
    pub fn split(&self, vector: &Tensor, prefix: &str) -> Result<Tensors> {
        let mut offset = 0;
        let view = |spec: &TensorSpec| {
            let tensor = vector.narrow(0, offset, spec.count())?.reshape(spec.shape.as_slice())?;
            offset += spec.count();
            Ok((format!("{prefix}{}", spec.name), tensor))
        };
        self.0.iter().map(view).collect()
    }

    /// The vector of the tensors that [`Self::split`] names, which it removes from `tensors`.
    pub fn join(
        &self,
        tensors: &mut Tensors,
        prefix: &str,
    ) -> std::result::Result<Tensor, NetworkError> {
        let mut flat = Vec::with_capacity(self.0.len());
        for spec in self.0.iter() {
            let tensor = take(tensors, format!("{prefix}{}", spec.name), &spec.shape)?;
            flat.push(tensor.flatten_all()?);
        }
        Ok(Tensor::cat(&flat, 0)?)
    }
}

/// Removes a tensor of f32 with this name and shape from `tensors`.
///
/// # Errors
/// A tensor that is missing, has another type or shape, or holds a number that is not finite.
pub fn take(
    tensors: &mut Tensors,
    name: String,
    shape: &[usize],
) -> std::result::Result<Tensor, NetworkError> {
    let Some(tensor) = tensors.remove(&name) else { return Err(NetworkError::Missing(name)) };
    let [actual, expected] =
        [(tensor.dtype(), tensor.dims()), (DType::F32, shape)].map(|form| format!("{form:?}"));
    if actual != expected {
        return Err(NetworkError::Shape(name, actual, expected));
    }
    check_finite(&name, &tensor)?;
    Ok(tensor)
}

/// Checks that a tensor holds neither a NaN nor an infinity.
pub fn check_finite(name: &str, tensor: &Tensor) -> std::result::Result<(), NetworkError> {
    let numbers = tensor.flatten_all()?.to_vec1::<f32>()?;
    match numbers.iter().all(|x| x.is_finite()) {
        true => Ok(()),
        false => Err(NetworkError::NotFinite(name.to_owned())),
    }
}

/// The weights of one network: a vector on one of candle's devices.
#[derive(Debug)]
pub struct Weights {
    layout: Layout,
    values: Tensor,
    buffer: Option<Arc<GradientBuffer>>,
}

impl Weights {
    /// Weights with gradients: one of candle's variables.
    pub fn trainable(layout: Layout, values: &Tensor) -> Result<Self> {
        let mut weights = Self::constant(layout, Var::from_tensor(values)?.into_inner());
        if has_fast_implementation(values.device()) {
            weights.buffer = Some(Arc::new(GradientBuffer::new(&weights.values)?));
        }
        Ok(weights)
    }

    /// Weights without gradients.
    pub fn constant(layout: Layout, values: Tensor) -> Self {
        Self { layout, values, buffer: None }
    }

    /// Constant weights of named tensors, which it removes from `tensors`.
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
        let values = self.values.detach().copy()?;
        Ok(Self::constant(self.layout.clone(), values))
    }

    /// The same weights as constants, in the same memory.
    pub fn detach(&self) -> Self {
        Self::constant(self.layout.clone(), self.values.detach())
    }

    /// Draws the initial values of a layout, `[P]`.
    pub fn initial(layout: &Layout, generator: &mut impl Rng, device: &Device) -> Result<Tensor> {
        let mut values = vec![0.0; layout.count()];
        let mut rest = &mut values[..];
        for spec in layout.0.iter() {
            let tensor = rest.split_off_mut(..spec.count()).unwrap_or_default();
            spec.fill(tensor, generator);
        }
        Tensor::from_vec(values, layout.count(), device)
    }

    /// The vector, `[P]`.
    pub fn values(&self) -> &Tensor {
        &self.values
    }

    /// The tensors in the vector.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Views of the named tensors, as constants.
    pub fn tensors(&self, prefix: &str) -> Result<Tensors> {
        self.layout.split(&self.values.detach(), prefix)
    }

    /// Overwrites the weights by named tensors, which it removes from `tensors`.
    pub fn load(
        &mut self,
        tensors: &mut Tensors,
        prefix: &str,
    ) -> std::result::Result<(), NetworkError> {
        let values = self.layout.join(tensors, prefix)?;
        let values = values.to_device(self.values.device())?;
        Ok(self.change(|mine| mine.slice_set(&values, 0, 0))?)
    }

    /// Changes the vector in place.
    pub fn change(&mut self, work: impl FnOnce(&Tensor) -> Result<()>) -> Result<()> {
        work(&self.values.detach())
    }

    /// Memory for the gradient, if the weights are trained by fast implementations.
    pub(crate) fn gradient_buffer(&self) -> Option<&Arc<GradientBuffer>> {
        self.buffer.as_ref()
    }

    /// The EMA update of a target network: w = (1 − rate)·w + rate·online.
    pub fn soft_update(&mut self, online: &Self, rate: f32) -> Result<()> {
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
            return read(&online, |online: &[f32]| {
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
    use crate::testing::{assert_close, numbers};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn tensors_have_their_initial_values() -> Result<()> {
        let spec = |name: &str, shape: &[usize], init| TensorSpec::new(name.into(), shape, init);
        let layout = Layout::new(vec![
            spec("wide", &[2, 3, 5], Init::Orthogonal(2.0)),
            spec("tall", &[1, 5, 3], Init::Orthogonal(2.0)),
            spec("scale", &[4], Init::Constant(1.0)),
            spec("flat", &[100], Init::Uniform(0.25)),
        ]);
        let generator = &mut ChaCha8Rng::seed_from_u64(0);
        let values = Weights::initial(&layout, generator, &Device::Cpu)?;
        let tensors = layout.split(&values, "")?;
        let products = tensors["wide"].matmul(&tensors["wide"].t()?)?; // [2, 3, 3]
        let identity = (Tensor::eye(3, DType::F32, &Device::Cpu)? * 4.0)?;
        assert_close("wide", &products, &identity.broadcast_left(2)?);
        let products = tensors["tall"].t()?.matmul(&tensors["tall"])?;
        assert_close("tall", &products, &identity.unsqueeze(0)?);
        assert_eq!(numbers(&tensors["scale"]), [1.0; 4]);
        let flat = numbers(&tensors["flat"]);
        assert!(flat.iter().all(|x| x.abs() < 0.25) && flat.iter().any(|x| x.abs() > 0.2));
        Ok(())
    }
}
