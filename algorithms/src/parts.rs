//! An algorithm's state as a list of named parts, by which it is saved and loaded.

use candle_core::{Device, Result, Tensor};
use quad_nn::{Adam, Layout, Tensors, Weighted, Weights, take};
use quad_policy::PolicyError;

use super::train_state::TrainState;

/// Writes other numbers over those of a tensor `[]` or `[n]`.
pub(super) fn write(tensor: &Tensor, numbers: &Tensor) -> Result<()> {
    tensor.flatten_all()?.slice_set(&numbers.flatten_all()?, 0, 0)
}

/// Something that updates change.
enum Part<'a> {
    Weights(&'a mut Weights),
    Adam(&'a mut Adam, Layout),
    /// A tensor `[]` or `[n]`.
    Number(&'a mut Tensor),
    /// A scalar on this device, which may be missing.
    Maybe(&'a mut Option<Tensor>, &'a Device),
}

/// Named parts. Names of networks are prefixes of their tensors' names.
#[derive(Default)]
pub struct Parts<'a>(Vec<(&'static str, Part<'a>)>);

impl<'a> Parts<'a> {
    /// The weights of a network.
    pub(super) fn weights(mut self, name: &'static str, weights: &'a mut Weights) -> Self {
        self.0.push((name, Part::Weights(weights)));
        self
    }

    /// The weights of a network, and its optimizer's moments.
    pub(super) fn trained<N: Weighted>(
        mut self,
        name: &'static str,
        trained: &'a mut TrainState<N>,
    ) -> Self {
        let TrainState { network, adam } = trained;
        self.0.push((name, Part::Adam(adam, network.weights().layout().clone())));
        self.weights(name, network.weights_mut())
    }

    /// A tensor `[]` or `[n]`.
    pub(super) fn number(mut self, name: &'static str, number: &'a mut Tensor) -> Self {
        self.0.push((name, Part::Number(number)));
        self
    }

    /// A scalar on this device, which may be missing.
    pub(super) fn maybe(
        mut self,
        name: &'static str,
        number: &'a mut Option<Tensor>,
        device: &'a Device,
    ) -> Self {
        self.0.push((name, Part::Maybe(number, device)));
        self
    }

    /// All tensors by name.
    ///
    /// # Errors
    /// Candle fails.
    pub fn save(self) -> Result<Tensors> {
        let mut tensors = Tensors::new();
        for (name, part) in self.0 {
            match part {
                Part::Weights(weights) => tensors.extend(weights.tensors(&format!("{name}."))?),
                Part::Adam(adam, layout) => {
                    tensors.extend(adam.tensors(&layout, &format!("{name}."))?)
                }
                Part::Number(number) | Part::Maybe(Some(number), _) => {
                    tensors.insert(name.to_owned(), number.flatten_all()?);
                }
                Part::Maybe(None, _) => {}
            }
        }
        Ok(tensors)
    }

    /// The weights of all networks.
    #[cfg(test)]
    pub fn networks(self) -> Vec<(&'static str, &'a mut Weights)> {
        let weights = |(name, part)| {
            if let Part::Weights(weights) = part { Some((name, weights)) } else { None }
        };
        self.0.into_iter().filter_map(weights).collect()
    }

    /// Takes each part's tensors out of `tensors`.
    ///
    /// # Errors
    /// A tensor that is missing or does not fit.
    pub fn load(self, tensors: &mut Tensors) -> std::result::Result<(), PolicyError> {
        for (name, part) in self.0 {
            match part {
                Part::Weights(weights) => weights.load(tensors, &format!("{name}."))?,
                Part::Adam(adam, layout) => adam.load(&layout, tensors, &format!("{name}."))?,
                Part::Number(number) => {
                    let saved = take(tensors, name.to_owned(), &[number.elem_count()])?;
                    write(number, &saved.to_device(number.device())?)?;
                }
                Part::Maybe(number, device) if tensors.contains_key(name) => {
                    *number = Some(
                        take(tensors, name.to_owned(), &[1])?
                            .reshape(())?
                            .to_device(device)?
                            .copy()?,
                    );
                }
                Part::Maybe(number, _) => *number = None,
            }
        }
        Ok(())
    }
}
