//! One MuJoCo simulation: state in, controls in, state out.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, Once, PoisonError};

use mujoco_rs::logging::set_log_handler;
use mujoco_rs::wrappers::mj_data::{MjData, MjtWarning};
use mujoco_rs::wrappers::mj_logging::MjLogMessage;
use mujoco_rs::wrappers::mj_model::MjModel;
use quad_dataset::{Drive, Noise};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::environment::EnvironmentError;

/// Stream of an episode's seed for the initial state.
const RESET_STREAM: u64 = 1;

/// The compiled model of a simulation, which the process shares. `mjcf` makes its text.
pub(super) fn model(
    simulation: &'static str,
    mjcf: impl FnOnce() -> String,
) -> Result<Arc<MjModel>, EnvironmentError> {
    static MODELS: Mutex<BTreeMap<&str, Arc<MjModel>>> = Mutex::new(BTreeMap::new());
    static LOGGING: Once = Once::new();
    let mut models = MODELS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(model) = models.get(simulation) {
        return Ok(Arc::clone(model));
    }
    // SAFETY: every use of MuJoCo starts with a compiled model, so none runs before this.
    LOGGING.call_once(|| unsafe { set_log_handler(log) });
    let model = MjModel::from_xml_string(&mjcf())
        .map_err(|error| EnvironmentError::Model { simulation, reason: error.to_string() })?;
    Ok(Arc::clone(models.entry(simulation).or_insert(Arc::new(model))))
}

/// Replaces MuJoCo's own handler, which appends to `MUJOCO_LOG.TXT` in the working directory.
fn log(message: &MjLogMessage) {
    tracing::debug!(target: "mujoco", "{}", message.subject());
}

/// The state of one simulation; many share a model.
pub(super) struct Physics {
    data: MjData<Arc<MjModel>>,
    frame_skip: usize,
    drive: Drive,
}

impl Physics {
    /// A simulation that holds each control for `frame_skip` of the model's time steps.
    pub(super) fn new(
        model: Arc<MjModel>,
        frame_skip: usize,
        drive: Drive,
    ) -> Result<Self, EnvironmentError> {
        let data = MjData::try_new(model)
            .map_err(|error| EnvironmentError::Allocation(error.to_string()))?;
        Ok(Self { data, frame_skip, drive })
    }

    /// Control period, seconds.
    pub(super) fn dt(&self) -> f64 {
        self.data.model_opt().timestep * self.frame_skip as f64
    }

    pub(super) fn qpos(&self) -> &[f64] {
        self.data.qpos()
    }

    pub(super) fn qvel(&self) -> &[f64] {
        self.data.qvel()
    }

    /// The last step's controls, in the motors' own units.
    pub(super) fn controls(&self) -> &[f64] {
        self.data.ctrl()
    }

    /// Restarts from the model's initial state with noise drawn from `seed`; the first two
    /// positions may be given.
    pub(super) fn reset(&mut self, seed: u64, noise: Noise, place: Option<[f64; 2]>) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(RESET_STREAM);
        self.start(|qpos, qvel| {
            let (Noise::Uniform(bound) | Noise::NormalVelocities(bound)) = noise;
            for value in &mut *qpos {
                *value += random.random_range(-bound..bound);
            }
            for value in qvel {
                *value += match noise {
                    Noise::Uniform(bound) => random.random_range(-bound..bound),
                    Noise::NormalVelocities(scale) => {
                        scale * random.sample::<f64, _>(StandardNormal)
                    }
                };
            }
            if let Some(place) = place {
                qpos[..2].copy_from_slice(&place);
            }
        });
    }

    /// Restarts from a given state.
    pub(super) fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.start(|initial_qpos, initial_qvel| {
            initial_qpos.copy_from_slice(qpos);
            initial_qvel.copy_from_slice(qvel);
        });
    }

    /// Restarts from the state that `init` makes of the model's initial `(qpos, qvel)`.
    ///
    /// Computes the accelerations, as Gymnasium does after a reset: they warm-start the solver, so
    /// the first step depends on them slightly.
    fn start(&mut self, init: impl FnOnce(&mut [f64], &mut [f64])) {
        self.data.reset();
        let (mut qpos, mut qvel) = (self.qpos().to_vec(), self.qvel().to_vec());
        init(&mut qpos, &mut qvel);
        self.data.qpos_mut().copy_from_slice(&qpos);
        self.data.qvel_mut().copy_from_slice(&qvel);
        self.data.forward();
    }

    /// Applies `action`, clipped to ±1, for one control period. Returns false if the step failed: a
    /// NaN in an action is not applied; if a simulation diverges, MuJoCo restores the initial state.
    #[must_use]
    pub(super) fn step(&mut self, action: &[f32]) -> bool {
        if action.iter().any(|value| value.is_nan()) {
            return false;
        }
        for (at, &value) in action.iter().enumerate() {
            let value = f64::from(value).clamp(-1.0, 1.0);
            match self.drive {
                Drive::Motors => {
                    let [_, strongest] = self.data.model().actuator_ctrlrange()[at];
                    self.data.ctrl_mut()[at] = strongest * value;
                }
                Drive::Displacement(furthest) => {
                    self.data.qpos_mut()[at] += furthest * value;
                    self.data.qvel_mut()[at] = 0.0;
                }
            }
        }
        for _ in 0..self.frame_skip {
            self.data.step();
        }
        let warnings = self.data.warning();
        let bad =
            [MjtWarning::mjWARN_BADQPOS, MjtWarning::mjWARN_BADQVEL, MjtWarning::mjWARN_BADQACC];
        bad.into_iter().all(|warning| warnings[warning as usize].number == 0)
    }
}
