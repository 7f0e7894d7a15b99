//! The agent of an experiment.

use std::sync::Arc;

use anyhow::{Context as _, anyhow};
use quad_algorithms::{Agent, AlgorithmError, Context};
use quad_dataset::{Transitions, Window};
use quad_protocol::{Origin, Snapshot};
use quad_run::config::{Device, Experiment};
use quad_run::folder::Checkpoint;
use quad_runtime::{Hint, hinted};

use super::device;

const TOO_LARGE: &str = "take smaller networks or fewer critics; or train without online steps and evaluations (--eval-interval 0), and \
                         score the last snapshot by `evaluator score`";
const OTHER_VERSION: &str =
    "begin anew with --fresh, or continue with the version of the learner that wrote it";

/// Makes the agent at step 0, before the run has a folder.
///
/// # Errors
/// The algorithm cannot start with its hyper-parameters or these transitions, or its policy is too
/// large to be sent to evaluators.
pub(crate) fn begin(
    experiment: &Experiment,
    device: Device,
    transitions: Transitions,
) -> anyhow::Result<Agent> {
    let agent = new_agent(experiment, device, transitions, experiment.batch_size as usize)?;
    if experiment.needs_evaluators() {
        let (bytes, most) = (agent.policy(origin(experiment))?.len(), Snapshot::MOST_FILE);
        if bytes > most {
            let error = anyhow!(
                "the policy's file has {bytes} bytes, and evaluators can be sent at most {most}"
            );
            return Err(hinted(error, TOO_LARGE));
        }
    }
    Ok(agent)
}

/// The agent over these transitions, with batches of this size.
pub(super) fn new_agent(
    experiment: &Experiment,
    device: Device,
    transitions: Transitions,
    batch_size: usize,
) -> anyhow::Result<Agent> {
    let context = Context {
        transitions: Arc::new(transitions),
        batch_size,
        total_steps: experiment.steps,
        online_steps: experiment.total_steps() - experiment.steps,
        window: Window::ONE,
        seed: experiment.seed,
        precision: experiment.precision,
        device: device::open(device)?,
    };
    Agent::new(experiment.definition()?, &experiment.agent, context).hint_of(AlgorithmError::hint)
}

/// Loads the state of an earlier incarnation of the run.
pub(crate) fn resume(
    agent: &mut Agent,
    Checkpoint { step, state }: &Checkpoint,
) -> anyhow::Result<()> {
    let loaded = agent.load(state).hint(OTHER_VERSION);
    loaded.with_context(|| format!("cannot continue from the checkpoint of step {step}"))
}

/// The origin of a run's snapshots; the step is set for each.
pub(crate) fn origin(experiment: &Experiment) -> Origin {
    let Experiment { environment, seed, episodes, .. } = experiment;
    Origin { environment: environment.clone(), seed: *seed, step: 0, episodes: *episodes }
}
