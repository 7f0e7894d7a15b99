//! Settings of a test's training run: small networks, few steps.

/// Sizes of a run; the rest is fixed and small.
#[derive(Clone, Copy)]
pub struct Setting {
    pub steps: u64,
    pub eval_interval: u64,
    pub episodes: u32,
    /// N_a: what makes an evaluator's job long or short.
    pub candidates: u32,
    pub hidden: u32,
    /// Online environment steps that follow `steps`; 0 without any.
    pub online_steps: u64,
}

/// Four evaluations, over within a second.
pub const SHORT: Setting = Setting {
    steps: 80,
    eval_interval: 20,
    episodes: 6,
    candidates: 2,
    hidden: 16,
    online_steps: 0,
};
/// A run that is still training when its test is over. The disk keeps up with its snapshots: a
/// learner that stops writes those that wait.
pub const ENDLESS: Setting = Setting { steps: 100_000_000, eval_interval: 2000, ..SHORT };
/// An endless run without a snapshot to evaluate before the test is over.
pub const IDLE: Setting = Setting { eval_interval: 50_000_000, ..ENDLESS };

impl Setting {
    pub fn to_toml(self) -> String {
        let Setting { steps, eval_interval, episodes, candidates, hidden, online_steps } = self;
        let online = match online_steps {
            0 => String::new(),
            steps => format!(
                "[online]\nsteps = {steps}\nupdates_per_step = 2\nwarmup = 100\nlag = 3\nsnapshot_interval = 500\n"
            ),
        };
        format!(
            r#"task = "hopper-demo"
steps = {steps}
eval_interval = {eval_interval}
episodes = {episodes}
seed = 1
batch_size = 16

[agent]
candidates = {candidates}
actor.hidden = [{hidden}, {hidden}, {hidden}]
critic.hidden = [{hidden}, {hidden}, {hidden}]
critics = 2
diffusion_steps = 5
actor_ema_start = 10
{online}"#
        )
    }
}
