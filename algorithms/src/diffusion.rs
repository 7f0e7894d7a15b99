//! What algorithms share that train a diffusion policy and critics: their networks with the EMAs,
//! and everything that is no equation. An algorithm of this kind is its [`DiffusionUpdate`].

use super::algorithm::{Algorithm, Measured};
use super::context::{Context, Minibatch};
use super::denoising::{Denoising, normal};
use super::parts::Parts;
use super::random::{Purpose, stream};
use super::replay::{Computed, Inputs, Replay};
use super::train_state::{TrainState, ensemble, initial};
use candle_core::{Device, Result, Tensor};
use quad_nn::{Ensemble, NoisePredictor, Tensors, Weighted};
use quad_policy::{Choice, DiffusionShape, PolicyConfig};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// The networks of such an algorithm, and what they learn from.
pub(super) struct Networks {
    pub context: Context,
    pub shape: DiffusionShape,
    /// ε_θ and its EMA.
    pub actor: TrainState<NoisePredictor>,
    pub target_actor: NoisePredictor,
    /// Q_1..Q_K and their EMA Q̂.
    pub critics: TrainState<Ensemble>,
    pub target_critics: Ensemble,
}

impl Networks {
    /// At step 0; each step takes the share `actor_decay` of its rate off the actor's weights. The
    /// sizes of observations and actions are the data's.
    pub fn new(layers: DiffusionShape, actor_decay: f32, context: Context) -> Result<Self> {
        let (observation_dim, action_dim) = (context.observation_dim(), context.action_dim());
        let shape = DiffusionShape { observation_dim, action_dim, ..layers };
        let weights = initial(&shape.actor().layout(), &context, 0)?;
        let target_actor = NoisePredictor::new(shape.actor(), weights.copy()?, context.precision);
        let actor = NoisePredictor::new(shape.actor(), weights, context.precision);
        let critics = ensemble(shape.critics(), &context, 1)?;
        Ok(Self {
            actor: TrainState::new(actor, actor_decay)?,
            target_actor,
            target_critics: critics.network.copy()?,
            critics,
            shape,
            context,
        })
    }

    /// The noise of S sampled actions for each state of a batch, `[T, B·S, a]`: a^T, then that of
    /// the reverse steps from t = T down to 2.
    pub fn chain_noise(&self, samples: usize, generator: &mut ChaCha8Rng) -> Result<Tensor> {
        let DiffusionShape { diffusion_steps, action_dim, .. } = self.shape;
        normal(
            (diffusion_steps, self.context.batch_size * samples, action_dim),
            generator,
            &Device::Cpu,
        )
    }

    /// t, each as likely, and ε for the actions of a batch.
    pub fn denoising(&self, generator: &mut ChaCha8Rng) -> Result<Denoising> {
        let DiffusionShape { diffusion_steps, action_dim, .. } = self.shape;
        let epsilon = normal((self.context.batch_size, action_dim), generator, &Device::Cpu)?;
        let t = (0..self.context.batch_size)
            .map(|_| generator.random_range(1..=diffusion_steps as u32));
        Denoising::new(&Vec::from_iter(t), epsilon, self.actor.network.schedule())
    }

    /// The batch's actions made noisy, and the noise that the actor predicts in them, `[B, a]`.
    pub fn denoise(&self, batch: &Minibatch, noise: &Denoising) -> Result<(Tensor, Tensor)> {
        let noisy = noise.noisy(&batch.actions)?;
        let predicted = self.actor.network.predict(&batch.observations, &noisy, &noise.t)?;
        Ok((noisy, predicted))
    }
}

/// The equations of one algorithm: its hyper-parameters, with what its updates change beside the
/// networks.
pub(super) trait DiffusionUpdate: Send {
    /// The random numbers of one update.
    type Noise: Inputs + Send;

    /// They are drawn on the CPU.
    fn noise(&self, networks: &Networks, generator: &mut ChaCha8Rng) -> Result<Self::Noise>;

    /// Sets the optimizers for update number `step`, from 0.
    fn begin(&mut self, networks: &mut Networks, step: u64) -> Result<()>;

    /// The work of an update, as [`Replay::start`] wants it.
    fn work(
        &mut self,
        networks: &mut Networks,
        batch: &Minibatch,
        noise: &Self::Noise,
    ) -> Result<Computed>;

    /// The losses of an update with the weights as they are, as [`Self::work`] gives them.
    fn evaluate(
        &self,
        networks: &Networks,
        batch: &Minibatch,
        noise: &Self::Noise,
    ) -> Result<Computed>;

    /// What only some updates do, behind the work of all.
    fn end(&mut self, _: &mut Networks, _step: u64) -> Result<()> {
        Ok(())
    }

    /// Metrics that are computed on the CPU, of the noise and of what an update computed beside
    /// scalars.
    fn measure(&self, _: &Networks, _: &Self::Noise, _others: &[f32]) -> Result<Measured> {
        Ok(Measured::new())
    }

    /// How the policy chooses among its samples, and its tensors.
    fn policy(&self, networks: &Networks) -> Result<(Choice, Tensors)>;

    /// Adds what updates change beside the networks.
    fn parts<'a>(&'a mut self, parts: Parts<'a>, _: &'a Device) -> Parts<'a> {
        parts
    }
}

/// Such an algorithm in the middle of a run.
pub(super) struct Diffusion<U: DiffusionUpdate> {
    pub update: U,
    pub networks: Networks,
    replay: Replay<(Minibatch, U::Noise)>,
    /// The number of the next update, and its noise, if a GPU left the time to draw it.
    next: Option<(u64, U::Noise)>,
}

impl<U: DiffusionUpdate> Diffusion<U> {
    pub fn new(networks: Networks, update: U) -> Self {
        Self { update, networks, replay: Replay::default(), next: None }
    }

    /// Update number `step` on a batch, with noise.
    pub fn step(&mut self, step: u64, inputs: &(Minibatch, U::Noise)) -> Result<Measured> {
        let Self { update, networks, replay, .. } = self;
        update.begin(networks, step)?;
        let device = networks.context.device.clone();
        replay.start(&device, inputs, |(batch, noise)| update.work(networks, batch, noise))?;
        update.end(networks, step)?;
        if device.is_cuda() {
            self.next = Some((step + 1, self.noise(step + 1)?));
        }
        let (mut measured, others) = self.replay.computed()?;
        measured.extend(self.update.measure(&self.networks, &inputs.1, &others)?);
        Ok(measured)
    }

    /// The random numbers of update number `step`.
    pub fn noise(&self, step: u64) -> Result<U::Noise> {
        self.update
            .noise(&self.networks, &mut stream(self.networks.context.seed, Purpose::Noise, step))
    }
}

impl<U: DiffusionUpdate> Algorithm for Diffusion<U> {
    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let noise = match self.next.take() {
            Some((of, noise)) if of == step => noise,
            _ => self.noise(step)?,
        };
        self.step(step, &(self.networks.context.batch_on(items, &Device::Cpu)?, noise))
    }

    fn evaluate(&self, step: u64, items: &[u32]) -> Result<Measured> {
        let Self { update, networks, .. } = self;
        let (batch, noise) = (networks.context.batch(items)?, self.noise(step)?);
        let (mut measured, others) =
            update.evaluate(networks, &batch, &noise.on(&networks.context.device)?)?.read()?;
        measured.extend(update.measure(networks, &noise, &others)?);
        Ok(measured)
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let (choice, tensors) = self.update.policy(&self.networks)?;
        Ok((PolicyConfig::Diffusion { shape: self.networks.shape.clone(), choice }, tensors))
    }

    fn parts(&mut self) -> Parts<'_> {
        // Who has the parts may put other tensors in their places.
        self.replay = Replay::default();
        let Networks { context, actor, target_actor, critics, target_critics, .. } =
            &mut self.networks;
        let parts = Parts::default()
            .trained("actor", actor)
            .trained("critic", critics)
            .weights("target_actor", target_actor.weights_mut())
            .weights("target_critic", target_critics.weights_mut());
        self.update.parts(parts, &context.device)
    }
}
