//! One MuJoCo simulation: state in, controls in, state out.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, Once, PoisonError};

use mujoco_rs::logging::set_log_handler;
use mujoco_rs::wrappers::mj_data::{MjData, MjtWarning};
use mujoco_rs::wrappers::mj_logging::MjLogMessage;
use mujoco_rs::wrappers::mj_model::MjModel;
use quad_dataset::Noise;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::environment::EnvironmentError;

/// The stream that initial states are drawn from, among those of an episode's seed.
const RESET_STREAM: u64 = 1;

/// The compiled model of a simulation. If the process does not have it yet, it is compiled from the
/// text that `mjcf` gives.
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
    // SAFETY: every use of MuJoCo in this program starts with a compiled model, so none runs before
    // this.
    LOGGING.call_once(|| unsafe { set_log_handler(log) });
    let model = MjModel::from_xml_string(&mjcf())
        .map_err(|error| EnvironmentError::Model { simulation, reason: error.to_string() })?;
    Ok(Arc::clone(models.entry(simulation).or_insert(Arc::new(model))))
}

/// Sends MuJoCo's messages to this program's log. MuJoCo's own handler appends to `MUJOCO_LOG.TXT`
/// in the working directory.
fn log(message: &MjLogMessage) {
    tracing::debug!(target: "mujoco", "{}", message.subject());
}

/// What an action does.
#[derive(Clone, Copy)]
pub(super) enum Drive {
    /// Its numbers are torques, as fractions of each motor's strongest.
    Motors,
    /// Before a step they are added to the positions, as fractions of so many meters, and
    /// velocities become 0.
    Displacement(f64),
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
            match noise {
                Noise::Uniform(bound) => {
                    for value in qpos.iter_mut().chain(qvel) {
                        *value += random.random_range(-bound..bound);
                    }
                }
                Noise::NormalVelocities(scale) => {
                    for value in qpos.iter_mut() {
                        *value += random.random_range(-scale..scale);
                    }
                    for value in qvel {
                        let normal: f64 = StandardNormal.sample(&mut random);
                        *value += scale * normal;
                    }
                }
            }
            if let Some(place) = place {
                qpos[..2].copy_from_slice(&place);
            }
        });
    }

    /// Restarts from a given state.
    pub(super) fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.start(|positions, velocities| {
            positions.copy_from_slice(qpos);
            velocities.copy_from_slice(qvel);
        });
    }

    /// Restarts from the state that `init` makes of the model's initial `(qpos, qvel)`.
    ///
    /// As in Gymnasium, this computes the accelerations after a reset: they warm-start the solver,
    /// so the first step depends on them slightly.
    fn start(&mut self, init: impl FnOnce(&mut [f64], &mut [f64])) {
        self.data.reset();
        // SAFETY: MuJoCo allocates both arrays, separately and with these lengths, for the life of
        // `data`.
        let (qpos, qvel) = unsafe {
            let (nq, nv) = (self.data.qpos().len(), self.data.qvel().len());
            let raw = self.data.ffi_mut();
            (
                std::slice::from_raw_parts_mut(raw.qpos, nq),
                std::slice::from_raw_parts_mut(raw.qvel, nv),
            )
        };
        init(qpos, qvel);
        self.data.forward();
    }

    /// Applies `action`, clipped to ±1, for one control period.
    ///
    /// False if the step failed: an action that is not a number is not applied; when a simulation
    /// diverges, MuJoCo replaces the state by the initial one.
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
        [MjtWarning::mjWARN_BADQPOS, MjtWarning::mjWARN_BADQVEL, MjtWarning::mjWARN_BADQACC]
            .iter()
            .all(|&warning| warnings[warning as usize].number == 0)
    }
}
