//! Kinds of policy, and how one is read from a file that says which it is.

use crate::error::{PolicyError, VERSION};
use crate::kinds::actor_critic::ActorCriticShape;
use crate::kinds::diffuser::{self, DiffuserPolicy};
use crate::kinds::diffusion::{ACTOR, CRITIC, DiffusionPolicy, DiffusionShape, VALUE};
use crate::kinds::gaussian::{GaussianPolicy, GaussianShape};
use crate::kinds::one_step::OneStepActor;
use crate::kinds::planner::DiffuserShape;
use crate::kinds::score::{FREQUENCIES, ScorePolicy, ScorePolicyShape};
use crate::kinds::squashed::SquashedActor;
use crate::policy::Policy;
use crate::sampling::choice::Choice;
use crate::scaled::scaled;
use candle_core::safetensors::Load;
use candle_core::{DType, Device, Tensor};
use quad_kernels::scaling::Scaling;
use quad_nn::{
    Layout, Precision, ScoreShape, Tensors, TrajectoryModel, TrajectoryValue, Weights, check_finite,
};
use safetensors::{SafeTensorError, SafeTensors};
use serde::de::{DeserializeOwned, IgnoredAny};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, HashMap};

/// Key of the header in a safetensors file's metadata.
const HEADER: &str = "quad";
/// Longest header of a safetensors file that is read, bytes. The paper's networks have 3 KB; a
/// million empty tensors would take a gigabyte of memory before anything else is known of them.
const MAX_HEADER: u64 = 1 << 20;

/// What a policy is: its kind, the shapes of its networks, and how it chooses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum PolicyConfig {
    /// One of several samples of a diffusion model.
    Diffusion {
        /// Shape of its networks.
        shape: DiffusionShape,
        /// Which sample it is.
        choice: Choice,
    },
    /// One of several samples of a tanh-squashed Gaussian.
    Squashed {
        /// Shape of its networks.
        shape: ActorCriticShape,
        /// Which sample it is.
        choice: Choice,
    },
    /// What a network says of state and noise, for one of several noises.
    #[serde(rename = "one-step")]
    OneStep {
        /// Shape of its networks.
        shape: ActorCriticShape,
        /// Which sample it is.
        choice: Choice,
    },
    /// The mean of a Gaussian.
    Gaussian {
        /// Shape of its network.
        shape: GaussianShape,
    },
    /// Some of several samples of a score network.
    Score {
        /// Shape of its networks.
        shape: ScorePolicyShape,
        /// Which samples they are.
        choice: Choice,
    },
    /// The first actions of one of several plans.
    #[serde(rename = "planner")]
    Diffuser {
        /// What it is beside its weights.
        shape: DiffuserShape,
        /// Which plan it is.
        choice: Choice,
    },
}

impl PolicyConfig {
    /// The tensors of such a policy whose networks have the numbers that `values` gives for their
    /// layouts, as [`Weights::initial`] does. Tests and benchmarks act with it.
    pub fn tensors(
        &self,
        mut values: impl FnMut(&Layout) -> candle_core::Result<Tensor>,
    ) -> candle_core::Result<Tensors> {
        let mut tensors = Tensors::new();
        let mut add = |prefix, layout: Layout| {
            let values = values(&layout)?;
            tensors.extend(Weights::constant(layout, values).tensors(prefix)?);
            candle_core::Result::Ok(())
        };
        match self {
            Self::Diffusion { shape, .. } => {
                add(ACTOR, shape.actor().layout())?;
                add(CRITIC, shape.critics().layout())?;
                shape.value().map(|value| add(VALUE, value.layout())).transpose()?;
            }
            Self::Squashed { shape, .. } => {
                add(ACTOR, SquashedActor::shape(shape).layout())?;
                add(CRITIC, shape.critics().layout())?;
            }
            Self::OneStep { shape, .. } => {
                add(ACTOR, OneStepActor::shape(shape).layout())?;
                add(CRITIC, shape.critics().layout())?;
            }
            Self::Gaussian { shape } => add(ACTOR, shape.actor().layout())?,
            Self::Score { shape, .. } => {
                add(ACTOR, shape.actor().layout())?;
                add(CRITIC, shape.critic().layout())?;
                let frequencies = Tensor::ones(ScoreShape::FREQUENCIES, DType::F32, &Device::Cpu)?;
                tensors.insert(FREQUENCIES.to_owned(), frequencies);
            }
            Self::Diffuser { shape, .. } => {
                add(diffuser::MODEL, TrajectoryModel::layout(&shape.network, shape.width()))?;
                add(diffuser::VALUE, TrajectoryValue::layout(&shape.network, shape.width()))?;
            }
        }
        Ok(tensors)
    }
}

/// What a policy's file says beside its tensors: JSON under one key of its metadata, written once,
/// with the tensors. `O` says where the policy comes from, which is not looked into here.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header<O> {
    /// What it is.
    pub policy: PolicyConfig,
    /// The maps between the units that its networks have learned in and those that it is asked in,
    /// unless they are the same.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scaling: Option<Scaling>,
    /// What the data that it has learned from calls the numbers of an observation; empty where they
    /// have no names.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub observation_names: Vec<String>,
    /// Names of the numbers of an action.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub action_names: Vec<String>,
    /// Where it comes from.
    pub origin: O,
    /// What `learner export` says of the data and of how good it is; nothing in a snapshot.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub about: Value,
    /// The version that wrote it; empty before 0.1.0 was released.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub version: String,
}

/// What is read of a header that is not understood.
#[derive(Deserialize)]
struct Written {
    version: String,
}

impl<O> Header<O> {
    /// The header of networks that have learned in the user's own units, from numbers without
    /// names.
    pub fn new(policy: PolicyConfig, origin: O) -> Self {
        let (observation_names, action_names, version) =
            (Vec::new(), Vec::new(), VERSION.to_owned());
        Self {
            policy,
            scaling: None,
            observation_names,
            action_names,
            origin,
            about: Value::Null,
            version,
        }
    }
}

impl<O: Serialize> Header<O> {
    /// The safetensors file of a policy with this header.
    ///
    /// # Errors
    /// A number that is not finite.
    pub fn to_safetensors(&self, tensors: &Tensors) -> Result<Vec<u8>, PolicyError> {
        write_tensors(tensors, HEADER, self)
    }
}

impl<O: DeserializeOwned> Header<O> {
    /// What a policy's file says of itself.
    ///
    /// # Errors
    /// As [`read_header`]; where another version wrote what is not understood, that is said.
    pub fn read(file: &[u8]) -> Result<Self, PolicyError> {
        read_header(file, HEADER).map_err(|error| match (error, read_header(file, HEADER)) {
            (PolicyError::Header(source), Ok(Written { version })) if version != VERSION => {
                PolicyError::Version { version, source }
            }
            (error, _) => error,
        })
    }
}

/// Reads a policy from its file: exactly the tensors that its header asks for, all finite. Where
/// the file has a scaling, the policy takes and gives the user's units.
///
/// # Errors
/// A file that is not what it should be, or a kind of policy that is not known here.
pub fn load_policy(file: &[u8], precision: Precision) -> Result<Box<dyn Policy>, PolicyError> {
    let Header { policy, scaling, origin: IgnoredAny, .. } = Header::read(file)?;
    let mut tensors = read_tensors(file)?;
    let policy: Box<dyn Policy> = match policy {
        PolicyConfig::Diffusion { shape, choice } => {
            Box::new(DiffusionPolicy::load(shape, choice, &mut tensors, precision)?)
        }
        PolicyConfig::Squashed { shape, choice } => {
            let of_actor = SquashedActor::shape(&shape);
            Box::new(shape.load(of_actor, SquashedActor::new, choice, &mut tensors, precision)?)
        }
        PolicyConfig::OneStep { shape, choice } => {
            let of_actor = OneStepActor::shape(&shape);
            Box::new(shape.load(of_actor, OneStepActor::new, choice, &mut tensors, precision)?)
        }
        PolicyConfig::Gaussian { shape } => Box::new(GaussianPolicy::load(shape, &mut tensors)?),
        PolicyConfig::Score { shape, choice } => {
            Box::new(ScorePolicy::load(shape, choice, &mut tensors, precision)?)
        }
        PolicyConfig::Diffuser { shape, choice } => {
            let units = shape.units.clone();
            scaled(Box::new(DiffuserPolicy::load(shape, choice, &mut tensors)?), Some(units))?
        }
    };
    match tensors.into_keys().next() {
        Some(name) => Err(PolicyError::Unexpected(name)),
        None => scaled(policy, scaling),
    }
}

/// The safetensors file of some tensors, with `header` as JSON under that key of its metadata:
/// always the same bytes for the same header and numbers.
///
/// # Errors
/// A number that is not finite.
pub fn write_tensors(
    tensors: &Tensors,
    key: &str,
    header: &impl Serialize,
) -> Result<Vec<u8>, PolicyError> {
    let mut here = BTreeMap::new();
    for (name, tensor) in tensors {
        check_finite(name, tensor)?;
        here.insert(name, tensor.to_device(&Device::Cpu)?);
    }
    let metadata = HashMap::from([(key.to_owned(), serde_json::to_string(header)?)]);
    Ok(safetensors::serialize(here, Some(metadata))?)
}

/// What [`write_tensors`] has written beside the tensors.
///
/// # Errors
/// No safetensors file, or one without such a header.
pub fn read_header<T: DeserializeOwned>(file: &[u8], key: &'static str) -> Result<T, PolicyError> {
    check_header(file)?;
    let (_, metadata) = SafeTensors::read_metadata(file)?;
    let header = metadata.metadata().as_ref().and_then(|metadata| metadata.get(key));
    Ok(serde_json::from_str(header.ok_or(PolicyError::NoHeader(key))?)?)
}

/// All tensors of a safetensors file, on the CPU.
///
/// # Errors
/// A file that cannot be read.
pub fn read_tensors(bytes: &[u8]) -> Result<Tensors, PolicyError> {
    check_header(bytes)?;
    let file = SafeTensors::deserialize(bytes)?;
    file.tensors().into_iter().map(|(name, view)| Ok((name, view.load(&Device::Cpu)?))).collect()
}

/// Checks the header's length, which the file's first eight bytes say; a file without them is
/// refused later.
fn check_header(file: &[u8]) -> Result<(), PolicyError> {
    match file.first_chunk() {
        Some(length) if u64::from_le_bytes(*length) > MAX_HEADER => {
            Err(SafeTensorError::HeaderTooLarge.into())
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests;
