//! Kinds of policy, and how one is read from a file that says which it is.

use crate::choice::Choice;
use crate::diffusion::{ACTOR, CRITIC, DiffusionPolicy, DiffusionShape, VALUE};
use crate::error::PolicyError;
use crate::gaussian::{GaussianPolicy, GaussianShape};
use crate::planner::{self, Planner, PlannerShape};
use crate::policy::Policy;
use crate::precision::Precision;
use crate::scaled::scaled;
use crate::score::{FREQUENCIES, ScorePolicy, ScorePolicyShape};
use crate::score_network::ScoreShape;
use crate::squashed::{SquashedPolicy, SquashedShape};
use crate::weights::{Layout, Tensors, Weights, check_finite};
use crate::window_networks::{WindowModel, WindowValue};
use candle_core::safetensors::Load;
use candle_core::{DType, Device, Tensor};
use quad_kernels::scaling::Scaling;
use safetensors::{SafeTensorError, SafeTensors};
use serde::de::{DeserializeOwned, IgnoredAny};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, HashMap};

/// Key of the header in a safetensors file's metadata.
const HEADER: &str = "quad";
/// The version that writes.
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");
/// Longest header of a safetensors file that is read, bytes. The paper's networks have 3 KB; a million empty tensors would
/// take a gigabyte of memory before anything else is known of them.
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
        shape: SquashedShape,
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
    Planner {
        /// What it is beside its weights.
        shape: PlannerShape,
        /// Which plan it is.
        choice: Choice,
    },
}

impl PolicyConfig {
    /// The tensors of such a policy whose networks have the numbers that `values` gives for their layouts, as
    /// [`Weights::initial`] does. Tests and benchmarks act with it.
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
                add(ACTOR, shape.actor().layout())?;
                add(CRITIC, shape.critics().layout())?;
            }
            Self::Gaussian { shape } => add(ACTOR, shape.actor().layout())?,
            Self::Score { shape, .. } => {
                add(ACTOR, shape.actor().layout())?;
                add(CRITIC, shape.critic().layout())?;
                let frequencies = Tensor::ones(ScoreShape::FREQUENCIES, DType::F32, &Device::Cpu)?;
                tensors.insert(FREQUENCIES.to_owned(), frequencies);
            }
            Self::Planner { shape, .. } => {
                add(planner::MODEL, WindowModel::layout(&shape.network, shape.width()))?;
                add(planner::VALUE, WindowValue::layout(&shape.network, shape.width()))?;
            }
        }
        Ok(tensors)
    }
}

/// What a policy's file says beside its tensors: JSON under one key of its metadata, written once, with the tensors. `O` says
/// where the policy comes from, which is not looked into here.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header<O> {
    /// What it is.
    pub policy: PolicyConfig,
    /// The maps between the units that its networks have learnt in and those that it is asked in, unless they are the same.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scaling: Option<Scaling>,
    /// What the data that it has learnt from calls the numbers of an observation; empty where they have no names.
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
    /// The header of networks that have learnt in the user's own units, from numbers without names.
    pub fn new(policy: PolicyConfig, origin: O) -> Self {
        let (observation_names, action_names, version) = (Vec::new(), Vec::new(), VERSION.to_owned());
        Self { policy, scaling: None, observation_names, action_names, origin, about: Value::Null, version }
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

/// Reads a policy from its file: exactly the tensors that its header asks for, all finite. Where the file has a scaling, the
/// policy takes and gives the user's units.
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
            Box::new(SquashedPolicy::load(&shape, choice, &mut tensors, precision)?)
        }
        PolicyConfig::Gaussian { shape } => Box::new(GaussianPolicy::load(shape, &mut tensors)?),
        PolicyConfig::Score { shape, choice } => Box::new(ScorePolicy::load(shape, choice, &mut tensors, precision)?),
        PolicyConfig::Planner { shape, choice } => {
            let units = shape.units.clone();
            scaled(Box::new(Planner::load(shape, choice, &mut tensors)?), Some(units))?
        }
    };
    match tensors.into_keys().next() {
        Some(name) => Err(PolicyError::Unexpected(name)),
        None => scaled(policy, scaling),
    }
}

/// The safetensors file of some tensors, with `header` as JSON under that key of its metadata: always the same bytes for the same
/// header and numbers.
///
/// # Errors
/// A number that is not finite.
pub fn write_tensors(tensors: &Tensors, key: &str, header: &impl Serialize) -> Result<Vec<u8>, PolicyError> {
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

/// Checks the header's length, which the file's first eight bytes say; a file without them is refused later.
fn check_header(file: &[u8]) -> Result<(), PolicyError> {
    match file.first_chunk() {
        Some(length) if u64::from_le_bytes(*length) > MAX_HEADER => Err(SafeTensorError::HeaderTooLarge.into()),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mlp_config::MlpConfig;
    use std::fmt::Write;

    /// A file of so many tensors without numbers.
    fn empty_tensors(count: usize) -> Vec<u8> {
        let mut header = String::from("{\"__metadata__\":{\"quad\":\"none\"}");
        for number in 0..count {
            write!(header, ",\"{number:07}\":{{\"dtype\":\"F32\",\"shape\":[0],\"data_offsets\":[0,0]}}").unwrap();
        }
        header.push('}');
        [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat()
    }

    #[test]
    fn a_header_that_is_too_long_is_not_even_read() {
        let refused = |file: &[u8]| {
            let [read, loaded] = [read_tensors(file).map(drop), load_policy(file, Precision::F32).map(drop)];
            [read, loaded].map(|result| matches!(result, Err(PolicyError::Unreadable(SafeTensorError::HeaderTooLarge))))
        };
        let many = empty_tensors(20_000);
        assert!(many.len() as u64 > MAX_HEADER && SafeTensors::deserialize(&many).is_ok());
        assert_eq!(refused(&many), [true; 2]);
        // Reading it would find that this is no text.
        let noise = [&(MAX_HEADER + 1).to_le_bytes()[..], &vec![0xff; 2 * MAX_HEADER as usize]].concat();
        assert_eq!(refused(&noise), [true; 2]);

        assert_eq!(read_tensors(&empty_tensors(10_000)).unwrap().len(), 10_000);
        for file in [&empty_tensors(10_000)[..], b"short", b""] {
            assert_eq!(refused(file), [false; 2]);
        }
    }

    /// The file of a Gaussian policy that is from `origin`.
    fn gaussian(origin: &str) -> Vec<u8> {
        let actor = MlpConfig::mish(&[4]);
        let shape = GaussianShape { observation_dim: 3, action_dim: 1, actor };
        let policy = PolicyConfig::Gaussian { shape };
        let tensors = policy.tensors(|layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu)).unwrap();
        Header::new(policy, origin).to_safetensors(&tensors).unwrap()
    }

    #[test]
    fn a_file_says_what_it_is_and_where_it_is_from() {
        let file = gaussian("\"a run\"");
        assert!((0..30).all(|_| gaussian("\"a run\"") == file), "the same file has the same bytes");
        let header = Header::<String>::read(&file).unwrap();
        assert_eq!(header.origin, "\"a run\"");
        let json = serde_json::to_string(&header.policy).unwrap();
        let actor = r#"{"hidden":[4],"activation":"mish","norm":false,"initial":"xavier"}"#;
        let shape = format!(r#"{{"observation_dim":3,"action_dim":1,"actor":{actor}}}"#);
        assert_eq!(json, format!(r#"{{"kind":"gaussian","shape":{shape}}}"#));
        let newer = json.replace("hidden", "width");
        assert!(serde_json::from_str::<PolicyConfig>(&newer).is_err(), "what is not known is not ignored");
        let tensor = Tensor::zeros(1, DType::F32, &Device::Cpu).unwrap();
        let nameless = safetensors::serialize([("weights", tensor)], None).unwrap();
        assert!(matches!(load_policy(&nameless, Precision::F32), Err(PolicyError::NoHeader(_))));
        assert!(matches!(Header::<u64>::read(&file), Err(PolicyError::Header(_))), "another origin than was wanted");
    }

    #[test]
    fn what_another_version_wrote_is_read_or_it_says_which_version_reads_it() {
        let text = |file: &[u8], from: &str, to: &str| {
            assert_eq!(from.len(), to.len());
            let at = file.windows(from.len()).position(|window| window == from.as_bytes()).unwrap();
            [&file[..at], to.as_bytes(), &file[at + from.len()..]].concat()
        };
        let (file, ours) = (gaussian(""), format!(r#"\"version\":\"{VERSION}\""#));
        let theirs = ours.replace(VERSION, &"9".repeat(VERSION.len()));
        let newer = text(&file, &ours, &theirs);
        assert!(load_policy(&newer, Precision::F32).is_ok(), "it says nothing that is not known here");
        let error = load_policy(&text(&newer, "gaussian", "quantile"), Precision::F32).err().unwrap().to_string();
        assert!(error.contains("version 99") && error.contains("quantile"), "{error}");
    }

    #[test]
    fn a_policy_says_the_precision_that_it_has() {
        let policy = load_policy(&gaussian(""), Precision::Bf16).unwrap();
        assert_eq!((policy.precision(), policy.choice()), (Precision::F32, None));
        assert!(matches!(policy.with_choice(Choice::best_of(1)), Err(PolicyError::NoCandidates)));
        assert!(matches!(policy.sample(&[0.0; 3], &mut [policy.begin(0)]), Err(PolicyError::NoCritics)));
        assert!(matches!(policy.value(&[0.0; 3], &[0.0]), Err(PolicyError::NoCritics)));
    }
}
