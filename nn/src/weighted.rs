//! The trait of all networks with weights.

use crate::weights::Weights;
use candle_core::Result;

/// A network with its weights.
pub trait Weighted {
    /// The weights.
    fn weights(&self) -> &Weights;

    /// The weights, to be changed. Drops kernels that were packed from them.
    fn weights_mut(&mut self) -> &mut Weights;

    /// The EMA update of a target network: w = (1 − rate)·w + rate·online.
    fn soft_update(&mut self, online: &Self, rate: f32) -> Result<()> {
        self.weights_mut().soft_update(online.weights(), rate)
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

/// Implements [`Weighted`] for a type with the field `weights`. Where the field `packing` holds
/// packed kernels, their MLP's path follows the type.
macro_rules! weighted {
    ($type:ty) => {
        impl crate::weighted::Weighted for $type {
            fn weights(&self) -> &crate::weights::Weights {
                &self.weights
            }

            fn weights_mut(&mut self) -> &mut crate::weights::Weights {
                &mut self.weights
            }
        }
    };
    ($type:ty, $($mlp:ident).+) => {
        impl crate::weighted::Weighted for $type {
            fn weights(&self) -> &crate::weights::Weights {
                &self.weights
            }

            fn weights_mut(&mut self) -> &mut crate::weights::Weights {
                self.packing = Default::default();
                &mut self.weights
            }
        }

        impl $type {
            /// Packs the kernels now, for a policy whose weights do not change anymore.
            pub fn packed(self) -> Result<Self> {
                self.packing.pack(&self.$($mlp).+, &self.weights)?;
                Ok(self)
            }
        }
    };
}
pub(crate) use weighted;
