//! An algorithm's state by name, by which it is saved and loaded.

use candle_core::{Result, Tensor};
use quad_nn::{Adam, Layout, Tensors, Weights, take};
use quad_policy::PolicyError;

/// Writes numbers over those of a tensor `[]` or `[n]`.
pub(super) fn write(tensor: &Tensor, numbers: &Tensor) -> Result<()> {
    tensor.flatten_all()?.slice_set(&numbers.flatten_all()?, 0, 0)
}

enum Entry<'a> {
    Weights(&'a mut Weights),
    Adam(&'a mut Adam, Layout),
    /// A tensor `[]` or `[n]`.
    Tensor(&'a mut Tensor),
}

/// Weights, moments of optimizers and other tensors by name. Names of networks are prefixes of
/// their tensors' names.
#[derive(Default)]
pub struct StateDict<'a>(Vec<(String, Entry<'a>)>);

/// State that updates change.
pub(super) trait Stateful {
    /// Adds the state to `dict` under a name.
    fn add_to<'a>(&'a mut self, dict: &mut StateDict<'a>, name: &str);
}

impl Stateful for Tensor {
    fn add_to<'a>(&'a mut self, dict: &mut StateDict<'a>, name: &str) {
        dict.0.push((name.to_owned(), Entry::Tensor(self)));
    }
}

impl<S: Stateful> Stateful for Option<S> {
    fn add_to<'a>(&'a mut self, dict: &mut StateDict<'a>, name: &str) {
        self.iter_mut().for_each(|state| state.add_to(dict, name));
    }
}

impl<'a> StateDict<'a> {
    pub(super) fn with(mut self, name: &str, state: &'a mut impl Stateful) -> Self {
        state.add_to(&mut self, name);
        self
    }

    pub(super) fn weights(&mut self, name: String, weights: &'a mut Weights) {
        self.0.push((name, Entry::Weights(weights)));
    }

    /// Adds the moments of an optimizer of weights of this layout.
    pub(super) fn adam(&mut self, name: String, adam: &'a mut Adam, layout: Layout) {
        self.0.push((name, Entry::Adam(adam, layout)));
    }

    /// All tensors by name.
    pub fn save(self) -> Result<Tensors> {
        let mut tensors = Tensors::new();
        for (name, entry) in self.0 {
            match entry {
                Entry::Weights(weights) => tensors.extend(weights.tensors(&format!("{name}."))?),
                Entry::Adam(adam, layout) => {
                    tensors.extend(adam.tensors(&layout, &format!("{name}."))?)
                }
                Entry::Tensor(tensor) => drop(tensors.insert(name, tensor.flatten_all()?)),
            }
        }
        Ok(tensors)
    }

    /// The weights of all networks.
    #[cfg(test)]
    pub fn networks(self) -> Vec<(String, &'a mut Weights)> {
        let weights = |(name, entry)| {
            if let Entry::Weights(weights) = entry { Some((name, weights)) } else { None }
        };
        self.0.into_iter().filter_map(weights).collect()
    }

    /// Takes each entry's tensors out of `tensors`.
    ///
    /// # Errors
    /// A tensor is missing or does not fit.
    pub fn load(self, tensors: &mut Tensors) -> std::result::Result<(), PolicyError> {
        for (name, entry) in self.0 {
            match entry {
                Entry::Weights(weights) => weights.load(tensors, &format!("{name}."))?,
                Entry::Adam(adam, layout) => adam.load(&layout, tensors, &format!("{name}."))?,
                Entry::Tensor(tensor) => {
                    let saved = take(tensors, name, &[tensor.elem_count()])?;
                    write(tensor, &saved.to_device(tensor.device())?)?;
                }
            }
        }
        Ok(())
    }
}
