//! Training of a diffusion policy with critics. An algorithm of this kind is a [`DiffusionUpdate`].

use super::losses::Computed;
use super::prelude::*;
use super::random::Random;
use super::replay::{Inputs, Replay};
use quad_nn::{NoisePredictor, Schedule};
use quad_policy::DiffusionShape;
use rand::Rng;

networks! {
    pub(super) struct Networks(shape: &DiffusionShape, init) {
        /// ε_θ.
        actor: WithTarget<NoisePredictor> = noise_predictor(shape, init),
        critic: WithTarget<Ensemble> = init.critics(shape.critics, &shape.critic),
    }
}

/// ε_θ with its target network.
pub(super) fn noise_predictor(
    shape: &DiffusionShape,
    init: &mut Initializer<'_>,
) -> Result<WithTarget<NoisePredictor>> {
    let (layout, precision) = (shape.actor().layout(), init.context.precision);
    let network = |weights| NoisePredictor::new(shape.actor(), weights, precision);
    init.network(&layout, network)?.with_target(|online| Ok(network(online.weights().copy()?)))
}

impl Networks {
    /// Sets the steps of actor and critics.
    pub fn set_steps(&mut self, [actor, critic]: [AdamStep; 2]) -> Result<()> {
        self.actor.set_step(actor)?;
        self.critic.set_step(critic)
    }

    /// Actions of the target actor in the next states, `[B·S, a]`.
    pub fn sample_next(&self, batch: &Batch, noise: &Tensor) -> Result<Tensor> {
        self.actor.target.sample(&batch.next_observations, noise)
    }
}

/// The batch's actions made noisy, and the noise that the actor predicts in them, `[B, a]`; in those
/// beyond the end of their episode, the noise itself.
pub(super) fn denoise(
    actor: &NoisePredictor,
    batch: &Batch,
    noise: &Denoising,
) -> Result<(Tensor, Tensor)> {
    let noisy = noise.noisy(&batch.actions)?;
    let predicted = actor.predict(&batch.observations, &noisy, &noise.t)?;
    Ok((noisy, batch.within_episodes(predicted, &noise.epsilon)?))
}

/// Denoising steps and noise for the actions of a batch.
#[derive(Clone)]
pub(super) struct Denoising {
    /// t in 1..=T, `[B]`.
    pub t: Tensor,
    /// ε, `[B, a]`.
    pub epsilon: Tensor,
    /// √ᾱ_t, in all columns of a row, `[B, a]`.
    signal: Tensor,
    /// √(1 − ᾱ_t), `[B, a]`.
    pub deviation: Tensor,
}

impl Inputs for Denoising {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        vec![&mut self.t, &mut self.epsilon, &mut self.signal, &mut self.deviation]
    }
}

impl Denoising {
    pub fn new(t: &[u32], epsilon: Tensor, schedule: &Schedule) -> Result<Self> {
        let (signal, deviation) = schedule.noising(t, epsilon.dim(1)?, epsilon.device())?;
        let t = Tensor::new(t, epsilon.device())?;
        Ok(Self { t, epsilon, signal, deviation })
    }

    /// √ᾱ_t·a + √(1 − ᾱ_t)·ε of actions a, all `[B, a]`.
    pub fn noisy(&self, actions: &Tensor) -> Result<Tensor> {
        (actions * &self.signal)? + (&self.epsilon * &self.deviation)?
    }

    /// The estimate of the clean actions in noisy ones, given a predicted noise ε: (a^t − √(1 −
    /// ᾱ_t)·ε)/√ᾱ_t, clipped to ±1, all `[B, a]`. [`Schedule::clean`] is for rows of one t, and rounds
    /// otherwise.
    pub fn clean(&self, noisy: &Tensor, predicted: &Tensor) -> Result<Tensor> {
        ((noisy - (predicted * &self.deviation)?)? / &self.signal)?.clamp(-1f32, 1f32)
    }
}

/// Draws the random numbers of a diffusion policy, on the CPU.
pub(super) struct Sampler<'a> {
    pub random: Random,
    pub batch_size: usize,
    pub shape: &'a DiffusionShape,
    pub actor: &'a NoisePredictor,
}

impl Sampler<'_> {
    /// The noise of S sampled actions for each state of a batch, `[T, B·S, a]`: a^T, then that of
    /// the reverse steps from t = T down to 2.
    pub fn chain(&mut self, name: &str, samples: usize) -> Result<Tensor> {
        let (steps, a) = (self.shape.diffusion_steps, self.shape.action_dim);
        self.random.normal(name, (steps, self.batch_size * samples, a))
    }

    /// Uniform t, and ε, for the actions of a batch.
    pub fn denoising(&mut self) -> Result<Denoising> {
        let (b, steps) = (self.batch_size, self.shape.diffusion_steps as u32);
        let epsilon = self.random.normal("epsilon", (b, self.shape.action_dim))?;
        let t = self.random.vector("t", |generator| {
            Ok((0..b).map(|_| generator.random_range(1..=steps)).collect())
        })?;
        Denoising::new(&t, epsilon, self.actor.schedule())
    }
}

/// The hyper-parameters, equations and other state of an algorithm.
///
/// `update` is what a GPU records, so it is the same in all steps: `begin` sets the learning rates
/// before it, and `end` does what only some steps do.
pub(super) trait DiffusionUpdate: Send {
    type Noise: Inputs + Send;

    fn noise(&self, sampler: Sampler<'_>) -> Result<Self::Noise>;

    fn begin(&mut self, networks: &mut Networks, step: u64, context: &Context) -> Result<()>;

    fn update(
        &mut self,
        networks: &mut Networks,
        batch: &Batch,
        noise: &Self::Noise,
    ) -> Result<Vec<Loss>>;

    fn end(&mut self, _: &mut Networks, _step: u64) -> Result<()> {
        Ok(())
    }

    /// The losses that [`Self::update`] descends, without a step.
    fn losses(&self, networks: &Networks, batch: &Batch, noise: &Self::Noise) -> Result<Vec<Loss>>;

    /// Metrics that are computed on the CPU, from the noise and the losses' metric inputs.
    fn measure(&self, _: &Networks, _: &Self::Noise, _inputs: &[f32]) -> Result<Measured> {
        Ok(Measured::new())
    }

    /// The policy's rule of choice, and its tensors.
    fn policy(&self, networks: &Networks) -> Result<(Choice, Tensors)>;

    /// Adds what updates change beside the networks.
    fn add_to<'a>(&'a mut self, dict: StateDict<'a>) -> StateDict<'a> {
        dict
    }
}

pub(super) struct Diffusion<U: DiffusionUpdate> {
    context: Context,
    shape: DiffusionShape,
    update: U,
    networks: Networks,
    replay: Replay<(Batch, U::Noise)>,
    /// The next step and its noise, if a GPU left the time to draw it.
    next: Option<(u64, U::Noise)>,
}

impl<U: DiffusionUpdate> Diffusion<U> {
    /// The networks have the data's sizes; `update` may initialize more of them.
    pub fn new(
        mut shape: DiffusionShape,
        context: Context,
        update: impl FnOnce(&mut Networks, &mut Initializer<'_>) -> Result<U>,
    ) -> Result<Self> {
        shape.observation_dim = context.observation_dim();
        shape.action_dim = context.action_dim();
        let init = &mut Initializer::new(&context);
        let mut networks = Networks::new(&shape, init)?;
        let update = update(&mut networks, init)?;
        let (replay, next) = (Replay::default(), None);
        Ok(Self { context, shape, update, networks, replay, next })
    }

    fn noise(&self, step: u64, batch_size: usize) -> Result<U::Noise> {
        let mut random = self.context.random(step);
        random.device = Device::Cpu;
        self.update.noise(Sampler {
            random,
            batch_size,
            shape: &self.shape,
            actor: &self.networks.actor,
        })
    }
}

impl<U: DiffusionUpdate> Algorithm for Diffusion<U> {
    fn copies_batches(&self) -> bool {
        true
    }

    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let noise = match self.next.take() {
            Some((next, noise)) if next == step => noise,
            _ => self.noise(step, batch.size())?,
        };
        let inputs = (batch.clone(), noise);
        let (update, networks) = (&mut self.update, &mut self.networks);
        update.begin(networks, step, &self.context)?;
        self.replay.start(&self.context.device, &inputs, |(batch, noise)| {
            update.update(networks, batch, noise)
        })?;
        update.end(networks, step)?;
        if self.context.device.is_cuda() {
            self.next = Some((step + 1, self.noise(step + 1, batch.size())?));
        }
        let (mut measured, numbers) = self.replay.computed()?;
        let (update, networks) = (&self.update, &self.networks);
        measured.extend(update.measure(networks, &inputs.1, &numbers)?);
        Ok(measured)
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        let noise = self.noise(step, batch.size())?;
        let on_device = noise.on(&self.context.device)?;
        let losses = self.update.losses(&self.networks, batch, &on_device)?;
        let (mut measured, numbers) = Computed::new(&losses)?.read()?;
        let (update, networks) = (&self.update, &self.networks);
        measured.extend(update.measure(networks, &noise, &numbers)?);
        Ok(measured)
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let (choice, tensors) = self.update.policy(&self.networks)?;
        let shape = self.shape.clone();
        Ok((PolicyConfig::Diffusion { shape, choice }, tensors))
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        // The caller may put other tensors in the places of those that were recorded.
        self.replay = Replay::default();
        self.update.add_to(self.networks.state_dict())
    }
}
