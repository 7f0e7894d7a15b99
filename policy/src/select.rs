//! Acting: the best of N_a candidates (Eq. 25), drawn from the target actor and valued by the target critics.

use crate::ensemble::{RoundedCritics, StateActions};
use crate::noise_predictor::RoundedActor;
use crate::{Architecture, CriticEnsemble, NoisePredictor, Parameters, PolicyError, Precision};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The stream, among those of an episode's seed, that action noise is drawn from.
const ACTION_STREAM: u64 = 2;

/// The noise that one episode's actions are drawn from. A stream for each episode: its result does not depend on which
/// other episodes shared a batch with it.
pub struct ActionNoise(ChaCha8Rng);

impl ActionNoise {
    /// The stream of an episode's seed, apart from any other use of that seed.
    pub fn new(episode_seed: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(episode_seed);
        generator.set_stream(ACTION_STREAM);
        Self(generator)
    }

    fn fill(&mut self, out: &mut [f32]) {
        out.fill_with(|| StandardNormal.sample(&mut self.0));
    }
}

/// A trained policy: target actor and target critics.
pub struct TargetPolicy {
    actor: NoisePredictor,
    critics: CriticEnsemble,
    parameters: Parameters,
    rounded_actor: RoundedActor,
    rounded_critics: RoundedCritics,
}

/// Candidates of a batch of states and what the critics say of them.
pub struct Selection {
    /// Candidate actions, `states × candidates × action_dim`.
    pub candidates: Vec<f32>,
    /// Ensemble-mean value of each, `states × candidates`.
    pub values: Vec<f32>,
    /// Index of the best, per state.
    pub chosen: Vec<usize>,
}

impl TargetPolicy {
    /// Takes weights as they are.
    pub fn new(parameters: Parameters, precision: Precision) -> Self {
        let architecture = *parameters.architecture();
        let (actor, critics) = (NoisePredictor::new(&architecture), CriticEnsemble::new(&architecture));
        let rounded_actor = actor.round(&parameters.actor, precision);
        let rounded_critics = critics.round(&parameters.critics, precision);
        Self { actor, critics, parameters, rounded_actor, rounded_critics }
    }

    /// Reads a snapshot's tensors: exactly those of the architecture, all finite.
    pub fn from_safetensors(
        architecture: Architecture,
        bytes: &[u8],
        precision: Precision,
    ) -> Result<Self, PolicyError> {
        Ok(Self::new(Parameters::from_safetensors(&architecture, bytes)?, precision))
    }

    /// The shapes.
    pub fn architecture(&self) -> &Architecture {
        self.parameters.architecture()
    }

    /// Chooses an action for each of n states.
    ///
    /// `observations` is `n × observation_dim`, `actions` (written) `n × action_dim`; `noise` has the stream of each
    /// state's episode. With one candidate the critics are not asked.
    pub fn select(&self, observations: &[f32], candidates: usize, noise: &mut [ActionNoise], actions: &mut [f32]) {
        let (n, a, steps) = (noise.len(), self.architecture().action_dim, self.architecture().diffusion_steps);
        let row = candidates * a;
        let mut draws = vec![0.0; steps * n * row];
        for (i, stream) in noise.iter_mut().enumerate() {
            for step in 0..steps {
                stream.fill(&mut draws[(step * n + i) * row..][..row]);
            }
        }
        if candidates == 1 {
            return self.actor.sample(&self.parameters.actor, &self.rounded_actor, observations, 1, &draws, actions);
        }
        let selection = self.select_with(observations, candidates, &draws);
        for (i, (action, chosen)) in actions.chunks_exact_mut(a).zip(&selection.chosen).enumerate() {
            action.copy_from_slice(&selection.candidates[i * row + chosen * a..][..a]);
        }
    }

    /// The same with the noise given: `T × states × candidates × action_dim`.
    pub fn select_with(&self, observations: &[f32], candidates: usize, noise: &[f32]) -> Selection {
        let rows = observations.len() / self.architecture().observation_dim * candidates;
        let mut actions = vec![0.0; rows * self.architecture().action_dim];
        self.actor.sample(&self.parameters.actor, &self.rounded_actor, observations, candidates, noise, &mut actions);
        let critics = self.architecture().critics;
        let mut each = vec![0.0; critics * rows];
        let input = StateActions { observations, actions: &actions, repeat: candidates };
        self.critics.values(&self.parameters.critics, &self.rounded_critics, input, &mut each);
        let mut values = vec![0.0; rows];
        for critic in each.chunks_exact(rows) {
            values.iter_mut().zip(critic).for_each(|(sum, q)| *sum += q / critics as f32);
        }
        let best = |values: &[f32]| (1..candidates).fold(0, |best, i| if values[i] > values[best] { i } else { best });
        let chosen = values.chunks_exact(candidates).map(best).collect();
        Selection { candidates: actions, values, chosen }
    }
}
