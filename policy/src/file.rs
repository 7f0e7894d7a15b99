//! The file of a policy: tensors and a header.

use crate::error::{PolicyError, Result, VERSION, check_range};
use crate::executor::{Chunk, executor};
use crate::kinds::actor_critic::{ACTOR, ActorCriticShape, CRITIC};
use crate::kinds::diffuser::{self, DiffuserPolicy, DiffuserShape};
use crate::kinds::diffusion::{DiffusionPolicy, DiffusionShape, VALUE};
use crate::kinds::flow::{FlowActor, OneStepActor};
use crate::kinds::gaussian::{GaussianPolicy, GaussianShape};
use crate::kinds::score::{FREQUENCIES, ScorePolicy, ScorePolicyShape};
use crate::kinds::squashed::SquashedActor;
use crate::policy::Policy;
use crate::sampling::choice::Choice;
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
/// Longest header of a safetensors file, bytes. The paper's networks have 3 KB; a million empty
/// tensors would take a gigabyte of memory before they can be refused.
const MAX_HEADER: u64 = 1 << 20;

/// The kind of a policy, the shapes of its networks, and its choice among candidates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
#[allow(missing_docs)]
pub enum PolicyConfig {
    /// A choice among samples of a diffusion model.
    Diffusion { shape: DiffusionShape, choice: Choice },
    /// A choice among samples of a tanh-squashed Gaussian.
    Squashed { shape: ActorCriticShape, choice: Choice },
    /// A choice among actions of a network of state and noise.
    #[serde(rename = "one-step")]
    OneStep { shape: ActorCriticShape, choice: Choice },
    /// A choice among the ends of a flow, which this many Euler steps follow.
    Flow { shape: ActorCriticShape, flow_steps: usize, choice: Choice },
    /// The mode of a Gaussian.
    Gaussian { shape: GaussianShape },
    /// A choice among samples of a score network.
    Score { shape: ScorePolicyShape, choice: Choice },
    /// The first actions of a choice among plans.
    #[serde(rename = "planner")]
    Diffuser { shape: DiffuserShape, choice: Choice },
}

impl PolicyConfig {
    /// Tensors of the policy's networks with the weights that `values` returns for their layouts, for
    /// tests and benchmarks.
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
                if shape.critics > 0 {
                    add(CRITIC, shape.critics().layout())?;
                }
                if let Some(value) = shape.value() {
                    add(VALUE, value.layout())?;
                }
            }
            Self::Squashed { shape, .. } => {
                add(ACTOR, SquashedActor::shape(shape).layout())?;
                add(CRITIC, shape.critics().layout())?;
            }
            Self::OneStep { shape, .. } => {
                add(ACTOR, OneStepActor::shape(shape).layout())?;
                add(CRITIC, shape.critics().layout())?;
            }
            Self::Flow { shape, .. } => {
                add(ACTOR, FlowActor::shape(shape).layout())?;
                add(CRITIC, shape.critics().layout())?;
            }
            Self::Gaussian { shape } => {
                add(ACTOR, shape.actor().layout())?;
                if let Some(log_std) = shape.log_std() {
                    add("", log_std)?;
                }
            }
            Self::Score { shape, .. } => {
                add(ACTOR, shape.actor().layout())?;
                add(CRITIC, shape.critic().layout())?;
                let frequencies = Tensor::ones(ScoreShape::FREQUENCIES, DType::F32, &Device::Cpu)?;
                tensors.insert(FREQUENCIES.to_owned(), frequencies);
            }
            Self::Diffuser { shape, .. } => {
                let (config, width) = (&shape.network, shape.width());
                add(diffuser::MODEL, TrajectoryModel::layout(config, width))?;
                add(diffuser::VALUE, TrajectoryValue::layout(config, width))?;
            }
        }
        Ok(tensors)
    }
}

/// The header of a policy's file: JSON in the metadata. `O` is the origin of the policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header<O> {
    /// Kind, shapes and choice.
    pub policy: PolicyConfig,
    /// The chunk that the networks know as one action; a single step in older files.
    #[serde(default, skip_serializing_if = "Chunk::is_single")]
    pub chunk: Chunk,
    /// Conversion between the networks' units and the user's, unless they are the same.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scaling: Option<Scaling>,
    /// Names of the numbers of an observation in the dataset; empty without names.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub observation_names: Vec<String>,
    /// Names of the numbers of an action.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub action_names: Vec<String>,
    /// Origin of the policy.
    pub origin: O,
    /// Facts about dataset and score from `learner export`; null in a snapshot.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub about: Value,
    /// Version that wrote the file; empty before 0.1.0.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub version: String,
}

/// The version in a header that cannot be parsed.
#[derive(Deserialize)]
struct Written {
    version: String,
}

impl<O> Header<O> {
    /// A header without chunks, scaling and names.
    pub fn new(policy: PolicyConfig, origin: O) -> Self {
        Self {
            policy,
            chunk: Chunk::default(),
            scaling: None,
            observation_names: Vec::new(),
            action_names: Vec::new(),
            origin,
            about: Value::Null,
            version: VERSION.to_owned(),
        }
    }
}

impl<O: Serialize> Header<O> {
    /// The safetensors file of a policy.
    ///
    /// # Errors
    /// A weight is not finite.
    pub fn to_safetensors(&self, tensors: &Tensors) -> Result<Vec<u8>> {
        write_tensors(tensors, HEADER, self)
    }
}

impl<O: DeserializeOwned> Header<O> {
    /// Reads the header of a policy's file.
    ///
    /// # Errors
    /// As [`read_header`], or [`PolicyError::Version`].
    pub fn read(file: &[u8]) -> Result<Self> {
        read_header(file, HEADER).map_err(|error| match (error, read_header(file, HEADER)) {
            (PolicyError::Header(source), Ok(Written { version })) if version != VERSION => {
                PolicyError::Version { version, source }
            }
            (error, _) => error,
        })
    }
}

/// Loads a policy, which takes and returns the user's units if the file has a scaling.
///
/// # Errors
/// The header is wrong, or the tensors are not exactly those of its networks, all finite.
pub fn load_policy(file: &[u8], precision: Precision) -> Result<Box<dyn Policy>> {
    let header = Header::<IgnoredAny>::read(file)?;
    let tensors = &mut read_tensors(file)?;
    let policy: Box<dyn Policy> = match header.policy {
        PolicyConfig::Diffusion { shape, choice } => {
            Box::new(DiffusionPolicy::load(&shape, choice, tensors, precision)?)
        }
        PolicyConfig::Squashed { shape, choice } => {
            let actor = SquashedActor::shape(&shape);
            Box::new(shape.load(actor, SquashedActor::new, choice, tensors, precision)?)
        }
        PolicyConfig::OneStep { shape, choice } => {
            let actor = OneStepActor::shape(&shape);
            Box::new(shape.load(actor, OneStepActor::new, choice, tensors, precision)?)
        }
        PolicyConfig::Flow { shape, flow_steps, choice } => {
            check_range("flow_steps", flow_steps, FlowActor::MOST_STEPS)?;
            let flow = FlowActor::shape(&shape);
            let new = |network| FlowActor::new(network, flow_steps);
            Box::new(shape.load(flow, new, choice, tensors, precision)?)
        }
        PolicyConfig::Gaussian { shape } => Box::new(GaussianPolicy::load(shape, tensors)?),
        PolicyConfig::Score { shape, choice } => {
            Box::new(ScorePolicy::load(&shape, choice, tensors)?)
        }
        PolicyConfig::Diffuser { shape, choice } => {
            let (units, chunk) = (shape.units.clone(), Chunk::open_loop(shape.replan_every));
            let policy = DiffuserPolicy::load(shape, choice, tensors)?;
            executor(Box::new(policy), chunk, units)?
        }
    };
    if let Some(name) = tensors.keys().next() {
        return Err(PolicyError::Unexpected(name.clone()));
    }
    executor(policy, header.chunk, header.scaling.unwrap_or_default())
}

/// A safetensors file of tensors, with `header` as JSON under `key` in its metadata. Equal arguments
/// give equal bytes.
///
/// # Errors
/// A number is not finite.
pub fn write_tensors(tensors: &Tensors, key: &str, header: &impl Serialize) -> Result<Vec<u8>> {
    let mut here = BTreeMap::new();
    for (name, tensor) in tensors {
        check_finite(name, tensor)?;
        here.insert(name, tensor.to_device(&Device::Cpu)?);
    }
    let metadata = HashMap::from([(key.to_owned(), serde_json::to_string(header)?)]);
    Ok(safetensors::serialize(here, Some(metadata))?)
}

/// Reads the header that [`write_tensors`] has written.
///
/// # Errors
/// Bytes that are not a safetensors file, or lack the header.
pub fn read_header<T: DeserializeOwned>(file: &[u8], key: &'static str) -> Result<T> {
    check_header(file)?;
    let (_, metadata) = SafeTensors::read_metadata(file)?;
    let texts = metadata.metadata().as_ref();
    let header = texts.and_then(|texts| texts.get(key));
    let header = header.ok_or(PolicyError::NoHeader(key))?;
    Ok(serde_json::from_str(header)?)
}

/// Reads all tensors of a safetensors file, on the CPU.
pub fn read_tensors(bytes: &[u8]) -> Result<Tensors> {
    check_header(bytes)?;
    let mut tensors = Tensors::new();
    for (name, view) in SafeTensors::deserialize(bytes)?.tensors() {
        tensors.insert(name, view.load(&Device::Cpu)?);
    }
    Ok(tensors)
}

/// Checks the length of the header, the file's first eight bytes. A shorter file is refused later.
fn check_header(file: &[u8]) -> Result<()> {
    match file.first_chunk() {
        Some(length) if u64::from_le_bytes(*length) > MAX_HEADER => {
            Err(SafeTensorError::HeaderTooLarge.into())
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests;
