//! The agent of an experiment, what it learns from, and its device.

use std::sync::Arc;

use anyhow::{Context as _, anyhow};
use quad_algorithms::{Agent, AlgorithmError, Context, Examples};
use quad_dataset::{Transitions, Window};
use quad_policy::Precision;
use quad_protocol::{Origin, Snapshot};
use quad_run::config::{Device, Experiment};
use quad_run::folder::Checkpoint;
use quad_runtime::{Hint, hinted};

const TOO_LARGE: &str = "take smaller networks or fewer critics; or train without online steps and evaluations (--eval-interval 0), and \
                         score the last snapshot by `evaluator score`";
const OTHER_VERSION: &str =
    "begin anew with --fresh, or continue with the version of the learner that wrote it";

/// Makes the agent at step 0, before the run has a folder, and what it learns from.
///
/// # Errors
/// The algorithm cannot start with its hyper-parameters or these transitions, or its policy is too
/// large to be sent to evaluators.
pub(crate) fn begin(
    experiment: &Experiment,
    device: Device,
    transitions: Transitions,
) -> anyhow::Result<(Agent, Examples)> {
    let transitions = Arc::new(transitions);
    let context = Context {
        transitions: transitions.clone(),
        total_steps: experiment.steps,
        online_steps: experiment.total_steps() - experiment.steps,
        window: Window::ONE,
        seed: experiment.seed,
        precision: experiment.precision,
        device: open_device(device)?,
    };
    let agent = Agent::new(experiment.definition()?, &experiment.agent, context);
    let agent = agent.hint_of(AlgorithmError::hint)?;
    let examples = agent.examples(transitions).hint_of(AlgorithmError::hint)?;
    if experiment.needs_evaluators() {
        let (bytes, most) = (agent.policy(origin(experiment))?.len(), Snapshot::MOST_FILE);
        if bytes > most {
            let error = anyhow!(
                "the policy's file has {bytes} bytes, and evaluators can be sent at most {most}"
            );
            return Err(hinted(error, TOO_LARGE));
        }
    }
    Ok((agent, examples))
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
    Origin {
        environment: experiment.environment.clone(),
        seed: experiment.seed,
        step: 0,
        episodes: experiment.episodes,
    }
}

/// Checks that the device is present and can compute with this precision.
pub(crate) fn check_device(device: Device, precision: Precision) -> anyhow::Result<()> {
    if device == Device::Cuda && precision != Precision::F32 {
        return Err(anyhow!("on a GPU the update computes in f32 only"))
            .hint("use --precision f32");
    }
    open_device(device).map(drop)
}

/// The device as candle knows it.
fn open_device(device: Device) -> anyhow::Result<candle_core::Device> {
    let hint = match cfg!(feature = "cuda") {
        true => {
            "does `nvidia-smi` show a GPU on this machine, and a driver for CUDA 13? --device cpu needs neither"
        }
        false => "build a learner that can by deploy/cuda.sh, or train with --device cpu",
    };
    match device {
        Device::Cpu => Ok(candle_core::Device::Cpu),
        Device::Cuda => {
            quad_nn::open_gpu().context("this learner cannot train on a GPU here").hint(hint)
        }
    }
}
