//! What all networks have: weights, and kernels that are laid out of them.

use crate::weights::Weights;
use candle_core::Result;

/// A network with its weights.
pub trait Weighted {
    /// Its weights.
    fn weights(&self) -> &Weights;

    /// Its weights, to be changed. Kernels that were laid out of them are dropped.
    fn weights_mut(&mut self) -> &mut Weights;

    /// The EMA update of a target network: w = (1 − rate)·w + rate·online.
    ///
    /// # Errors
    /// Candle fails.
    fn soft_update(&mut self, online: &Self, rate: f32) -> Result<()> {
        self.weights_mut().ema_update(online.weights(), rate)
    }
}

impl Weighted for Weights {
    fn weights(&self) -> &Weights {
        self
    }

    fn weights_mut(&mut self) -> &mut Weights {
        self
    }
}

/// Implements it for a network type with the fields `weights` and `packing`, whose products are
/// those of the MLP in a field.
macro_rules! weighted {
    ($type:ty, $($mlp:ident).+) => {
        impl crate::weighted::Weighted for $type {
            fn weights(&self) -> &Weights {
                &self.weights
            }

            fn weights_mut(&mut self) -> &mut Weights {
                self.packing = Packing::new(self.packing.precision);
                &mut self.weights
            }
        }

        impl $type {
            /// Lays its kernels out for products now: for a policy that acts, whose weights do not
            /// change.
            pub fn packed(self) -> Result<Self> {
                self.packing.pack(&self.$($mlp).+, &self.weights)?;
                Ok(self)
            }
        }
    };
}
pub(crate) use weighted;
