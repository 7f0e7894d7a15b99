//! The weights of a network: one flat vector, with named tensors in it.

use crate::error::PolicyError;
use crate::slices::{has_fast_body, modify};
use candle_core::backprop::GradStore;
use candle_core::{DType, Device, Result, Tensor, Var};
use rand::Rng;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Tensors by name.
pub type Tensors = BTreeMap<String, Tensor>;

/// A named tensor's place in a flat vector.
#[derive(Clone, Debug)]
pub struct Part {
    /// Its name within the network, e.g. `trunk.0.kernel`.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Where in the vector it begins.
    pub offset: usize,
}

impl Part {
    fn count(&self) -> usize {
        self.shape.iter().product()
    }
}

/// The named tensors of a network, in the order in which they follow one another in its vector, without gaps.
#[derive(Clone, Debug)]
pub struct Layout(Arc<[Part]>);

impl Layout {
    /// The layout of these parts.
    pub fn new(parts: Vec<Part>) -> Self {
        Self(parts.into())
    }

    /// Numbers in the vector.
    pub fn count(&self) -> usize {
        self.0.last().map_or(0, |part| part.offset + part.count())
    }

    /// The tensors in a vector of this layout, as views of it, named with `prefix` before each name.
    pub fn split(&self, vector: &Tensor, prefix: &str) -> Result<Tensors> {
        let view = |part: &Part| {
            let tensor = vector.narrow(0, part.offset, part.count())?.reshape(part.shape.as_slice())?;
            Ok((format!("{prefix}{}", part.name), tensor))
        };
        self.0.iter().map(view).collect()
    }

    /// Puts a vector together of the tensors that [`Self::split`] names, and takes them out of `tensors`.
    ///
    /// # Errors
    /// One that is missing, or has another type or shape, or a number that is not finite.
    pub fn join(&self, tensors: &mut Tensors, prefix: &str) -> std::result::Result<Tensor, PolicyError> {
        let mut flat = Vec::with_capacity(self.0.len());
        for part in self.0.iter() {
            let name = format!("{prefix}{}", part.name);
            let Some(tensor) = tensors.remove(&name) else { return Err(PolicyError::Missing(name)) };
            if tensor.dtype() != DType::F32 {
                return Err(PolicyError::Type { name, found: format!("{:?}", tensor.dtype()) });
            }
            if tensor.dims() != part.shape {
                return Err(PolicyError::Shape { name, found: tensor.dims().to_vec(), expected: part.shape.clone() });
            }
            check_finite(&name, &tensor)?;
            flat.push(tensor.flatten_all()?);
        }
        Ok(Tensor::cat(&flat, 0)?)
    }
}

/// That a tensor holds neither a NaN nor an infinity.
pub fn check_finite(name: &str, tensor: &Tensor) -> std::result::Result<(), PolicyError> {
    let numbers = tensor.flatten_all()?.to_vec1::<f32>()?;
    if numbers.iter().all(|x| x.is_finite()) { Ok(()) } else { Err(PolicyError::NotFinite(name.to_owned())) }
}

/// Weights of one network, as a vector on one of candle's devices.
#[derive(Debug)]
pub struct Weights {
    layout: Layout,
    values: Tensor,
    kept: Option<Arc<KeptGradient>>,
    changes: u64,
}

impl Weights {
    /// Weights that gradients are taken of: a variable of candle's.
    pub fn trainable(layout: Layout, values: &Tensor) -> Result<Self> {
        let values = Var::from_tensor(values)?.into_inner();
        let kept = if has_fast_body(values.device()) { Some(Arc::new(KeptGradient::new(&values)?)) } else { None };
        Ok(Self { layout, values, kept, changes: 0 })
    }

    /// Weights that no gradient is taken of.
    pub fn constant(layout: Layout, values: Tensor) -> Self {
        Self { layout, values, kept: None, changes: 0 }
    }

    /// A constant copy.
    pub fn copy(&self) -> Result<Self> {
        Ok(Self::constant(self.layout.clone(), self.values.detach().copy()?))
    }

    /// The same vector as a constant; it changes with this one.
    pub(crate) fn frozen(&self) -> Self {
        Self::constant(self.layout.clone(), self.values.detach())
    }

    /// Xavier-uniform kernels, U(±√(6/(in + out))), and zero biases.
    pub fn initial(layout: &Layout, generator: &mut impl Rng, device: &Device) -> Result<Tensor> {
        let mut values = vec![0.0; layout.count()];
        for part in layout.0.iter().filter(|part| part.name.ends_with("kernel")) {
            let [.., inputs, outputs] = part.shape[..] else { continue };
            let bound = (6.0 / (inputs + outputs) as f32).sqrt();
            values[part.offset..][..part.count()].fill_with(|| generator.random_range(-bound..bound));
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
    pub fn load(&mut self, tensors: &mut Tensors, prefix: &str) -> std::result::Result<(), PolicyError> {
        let values = self.layout.join(tensors, prefix)?.to_device(self.values.device())?;
        Ok(self.change(|mine| mine.slice_set(&values, 0, 0))?)
    }

    /// Changes the vector in place, after which kernels that were rounded from it are rounded again.
    pub fn change(&mut self, work: impl FnOnce(&Tensor) -> Result<()>) -> Result<()> {
        self.changes += 1;
        work(&self.values.detach())
    }

    /// How often they were changed.
    pub(crate) fn changes(&self) -> u64 {
        self.changes
    }

    /// Where a custom operation leaves the gradient of these weights.
    pub(crate) fn kept_gradient(&self) -> Option<Arc<KeptGradient>> {
        self.kept.clone()
    }

    /// The gradient of the loss that `gradients` are of. Take it exactly once after each backward pass: one that is not taken is
    /// added to the next.
    ///
    /// # Errors
    /// If the loss does not depend on these weights.
    pub fn gradient(&self, gradients: &GradStore) -> Result<Tensor> {
        // A loss may reach the weights through custom operations, plain ones, or both.
        match (self.kept.as_ref().and_then(|kept| kept.take()), gradients.get(&self.values)) {
            (Some(kept), Some(returned)) => kept + returned,
            (Some(gradient), None) => Ok(gradient),
            (None, Some(gradient)) => Ok(gradient.clone()),
            (None, None) => candle_core::bail!("the loss does not depend on the weights that it is to train"),
        }
    }
}

/// A gradient in memory that is kept from step to step. Handing megabytes to candle's `GradStore` instead costs some
/// milliseconds in each backward pass: they are allocated three times over, and given back to the system.
#[derive(Debug)]
pub(crate) struct KeptGradient {
    values: Tensor,
    written: AtomicBool,
}

impl KeptGradient {
    fn new(weights: &Tensor) -> Result<Self> {
        Ok(Self { values: weights.zeros_like()?.detach(), written: AtomicBool::new(false) })
    }

    /// Has `work` write the gradient; added up where the weights have a part in the loss more than once.
    pub fn write(&self, work: impl FnOnce(&mut [f32])) -> Result<()> {
        if !self.written.swap(true, Ordering::Relaxed) {
            return modify(&self.values, work);
        }
        let mut more = vec![0.0; self.values.elem_count()];
        work(&mut more);
        modify(&self.values, |sum| sum.iter_mut().zip(&more).for_each(|(sum, x)| *sum += x))
    }

    fn take(&self) -> Option<Tensor> {
        self.written.swap(false, Ordering::Relaxed).then(|| self.values.clone())
    }
}
