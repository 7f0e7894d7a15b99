//! Helpers of tests.

use crate::error::Result;
use crate::file::{Header, PolicyConfig, load_policy};
use crate::kinds::actor_critic::ActorCriticShape;
use crate::kinds::diffusion::DiffusionShape;
use crate::policy::{Policy, Samples};
use crate::sampling::choice::Choice;
use candle_core::{Device, Tensor};
use quad_nn::{Activation, Layout, MlpConfig, Precision, Scaling, Tensors, Weights};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// The file of a policy whose networks have the weights that `values` returns for their layouts.
fn file_with(
    policy: PolicyConfig,
    scaling: Option<Scaling>,
    mut values: impl FnMut(&Layout) -> Vec<f32>,
) -> Vec<u8> {
    let values = |layout: &Layout| Tensor::new(values(layout), &Device::Cpu);
    let tensors = policy.tensors(values).unwrap();
    let mut header = Header::new(policy, ());
    header.scaling = scaling;
    header.to_safetensors(&tensors).unwrap()
}

/// The file of a policy with these weights of one network after the other.
pub(crate) fn with_weights(policy: PolicyConfig, weights: Vec<Vec<f32>>) -> Vec<u8> {
    let mut weights = weights.into_iter();
    file_with(policy, None, |_| weights.next().unwrap())
}

/// The file of a policy that lacks the weights.
pub(crate) fn without_tensors(policy: PolicyConfig) -> Vec<u8> {
    let header = Header::new(policy, ());
    header.to_safetensors(&Tensors::new()).unwrap()
}

/// The file of a policy with initial weights.
pub(crate) fn initial(policy: PolicyConfig) -> Vec<u8> {
    let generator = &mut ChaCha8Rng::seed_from_u64(5);
    file_with(policy, None, |layout| {
        let weights = Weights::initial(layout, generator, &Device::Cpu);
        weights.unwrap().to_vec1().unwrap()
    })
}

pub(crate) fn layers(activation: Activation, hidden: &[usize]) -> MlpConfig {
    let mut layers = MlpConfig::mish(hidden);
    layers.activation = activation;
    layers
}

/// The shape of a policy of one number of state, whose two critics and actor have two units.
pub(crate) fn two_units(action_dim: usize) -> ActorCriticShape {
    ActorCriticShape {
        observation_dim: 1,
        action_dim,
        actor: layers(Activation::Relu, &[2]),
        critic: layers(Activation::Relu, &[2]),
        critics: 2,
    }
}

/// The shape of a small diffusion policy.
pub(crate) fn small() -> DiffusionShape {
    DiffusionShape::quad((4, 2), &MlpConfig::mish(&[8; 3]), 2, 2)
}

/// The file of a [`small`] policy. The critics' weights are ±`critic`; `v` is the value of every
/// state, if the policy has a value function.
pub(crate) fn diffusion_file(
    choice: Choice,
    critic: f32,
    v: Option<f32>,
    scaling: Option<Scaling>,
) -> Vec<u8> {
    let mut shape = small();
    shape.value = v.map(|_| small().critic);
    let policy = PolicyConfig::Diffusion { shape, choice };
    // Magnitude and last weight of actor, critics and value function.
    let mut sizes = [(0.1, 0.1), (critic, critic), (0.0, v.unwrap_or(0.0))].into_iter();
    file_with(policy, scaling, |layout| {
        let (size, last) = sizes.next().unwrap();
        let signed = |i: usize| [size, -size][i / 3 % 2];
        let mut weights: Vec<f32> = (1..layout.count()).map(signed).collect();
        weights.push(last);
        weights
    })
}

pub(crate) fn load(file: &[u8]) -> Result<Box<dyn Policy>> {
    load_policy(file, Precision::F32)
}

/// The actions at the first step of episodes with these seeds.
pub(crate) fn act(policy: &dyn Policy, observations: &[f32], seeds: &[u64]) -> Result<Vec<f32>> {
    let mut states: Vec<_> = seeds.iter().map(|seed| policy.begin(*seed)).collect();
    let mut actions = vec![0.0; seeds.len() * policy.action_dim()];
    policy.act(observations, &mut states, &mut actions)?;
    Ok(actions)
}

/// The candidates at the first step of episodes with these seeds.
pub(crate) fn sample(policy: &dyn Policy, observations: &[f32], seeds: &[u64]) -> Result<Samples> {
    let mut states: Vec<_> = seeds.iter().map(|seed| policy.begin(*seed)).collect();
    policy.sample(observations, &mut states)
}

pub(crate) fn argmax(values: &[f32]) -> usize {
    let order = |i: &usize, j: &usize| values[*i].total_cmp(&values[*j]);
    (0..values.len()).max_by(order).unwrap()
}
