//! What a training run of a test is asked to do: small networks, few steps.

/// What a test may choose of a run; the rest of its preset is fixed and small.
#[derive(Clone, Copy)]
pub struct Setting {
    /// Gradient steps.
    pub steps: u64,
    /// Gradient steps between two evaluations.
    pub eval_interval: u64,
    /// Episodes per evaluation.
    pub episodes: u32,
    /// N_a: what makes an evaluator's job long or short.
    pub candidates: u32,
    /// Width of the networks.
    pub hidden: u32,
    /// Seed of the run.
    pub seed: u64,
}

/// Four evaluations, over within a second.
pub const SHORT: Setting = Setting { steps: 80, eval_interval: 20, episodes: 6, candidates: 2, hidden: 16, seed: 1 };
/// A run that is still training when its test is over.
pub const ENDLESS: Setting = Setting { steps: 100_000_000, eval_interval: 500, ..SHORT };
/// The same, without a snapshot to evaluate before the test is over.
pub const IDLE: Setting = Setting { eval_interval: 50_000_000, ..ENDLESS };

impl Setting {
    /// The steps that are evaluated.
    pub fn evaluated_steps(&self) -> Vec<u64> {
        (1..=self.steps).filter(|step| step % self.eval_interval == 0 || *step == self.steps).collect()
    }

    /// The text of a preset.
    pub fn to_toml(self) -> String {
        let Setting { steps, eval_interval, episodes, candidates, hidden, seed } = self;
        format!(
            r#"environment = "hopper"
reward = "locomotion"
steps = {steps}
eval_interval = {eval_interval}
episodes = {episodes}
candidates = {candidates}
seed = {seed}
batch_size = 16
algorithm = "quad"

[agent]
hidden = {hidden}
critics = 2
diffusion_steps = 2
gamma = 0.99
rho = 1.0
guidance = "quad"
tau = 1.0
delta = 1e-6
samples = 1
target_reduce = "mean"
actor_learning_rate = 1e-3
critic_learning_rate = 1e-3
gradient_clip = 1.0
ema_rate = 5e-3
nu_ema_rate = 5e-3
actor_ema_every = 5
actor_ema_start = 10

[agent.eta]
initial = 1.0
rate = 1e-3
minimum = 1e-3
maximum = 100.0
"#
        )
    }
}
