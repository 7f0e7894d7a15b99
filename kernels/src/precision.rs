//! The precision of products.

#[cfg(target_arch = "x86_64")]
use crate::avx512;
use crate::level::Level;
use serde::de::{self, IntoDeserializer};
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// Arithmetic of the products between hidden layers: forward, and the gradients of inputs and of
/// weights. All else is f32: the first and the last layer, activations, losses, optimizers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// f32 throughout.
    #[default]
    F32,
    /// Factors rounded to bfloat16 (8 bits of mantissa), sums in f32 (Micikevicius et al. 2018).
    /// Twice as fast on AMD's CPUs with AVX512-BF16, more on those with AMX; others compute in f32.
    Bf16,
}

impl Precision {
    /// Message to users whose CPU does not have the requested arithmetic.
    pub const UNAVAILABLE: &str =
        "this CPU is no faster in bf16, which takes AMX or AMD's AVX512-BF16: it computes in f32";

    /// Name on command lines and in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Precision::F32 => "f32",
            Precision::Bf16 => "bf16",
        }
    }

    /// The precision that this CPU computes with if this one is requested.
    pub fn in_effect(self) -> Self {
        if rounding_is_faster() { self } else { Precision::F32 }
    }

    /// The precision in effect and its instructions, e.g. `bf16-amx`, as on the wire and in
    /// `scores.jsonl`. Two CPUs compute the same bits only if this is the same.
    pub fn arithmetic(self) -> String {
        let precision = self.in_effect();
        let instructions = instructions(precision == Precision::Bf16);
        format!("{}-{instructions}", precision.name())
    }

    /// True if this CPU computes with it, rather than with f32 in its place.
    pub fn is_available(self) -> bool {
        self.in_effect() == self
    }
}

impl FromStr for Precision {
    type Err = de::value::Error;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::deserialize(name.into_deserializer())
    }
}

/// True if this CPU multiplies in bf16 faster than in f32.
fn rounding_is_faster() -> bool {
    #[cfg(target_arch = "x86_64")]
    let available = avx512::bf16::available();
    #[cfg(not(target_arch = "x86_64"))]
    let available = false;
    available
}

/// The instructions of products, in f32 or `rounded`. Other instructions add in another order, and
/// so give other last bits.
fn instructions(rounded: bool) -> &'static str {
    #[cfg(target_arch = "x86_64")]
    let names = if rounded { avx512::bf16::instructions() } else { Level::in_use().name() };
    #[cfg(not(target_arch = "x86_64"))]
    let names = if rounded { "none" } else { Level::in_use().name() };
    names
}
