//! One MuJoCo simulation: state in, controls in, state out.

use std::sync::{Arc, Once};

use mujoco_rs::logging::set_log_handler;
use mujoco_rs::wrappers::mj_data::{MjData, MjtWarning};
use mujoco_rs::wrappers::mj_logging::MjLogMessage;
use mujoco_rs::wrappers::mj_model::MjModel;

use super::EnvironmentError;

/// Compiles an MJCF text.
pub(super) fn compile(environment: &'static str, mjcf: &str) -> Result<Arc<MjModel>, EnvironmentError> {
    static LOGGING: Once = Once::new();
    // SAFETY: every use of MuJoCo in this program starts with a compiled model, so none runs before this has.
    LOGGING.call_once(|| unsafe { set_log_handler(log) });
    MjModel::from_xml_string(mjcf)
        .map(Arc::new)
        .map_err(|error| EnvironmentError::Model { environment, reason: error.to_string() })
}

/// MuJoCo's messages go where ours go; left alone it appends to a `MUJOCO_LOG.TXT` in the working directory.
fn log(message: &MjLogMessage) {
    tracing::debug!(target: "mujoco", "{}", message.subject());
}

/// The state of one simulation; many share a model.
pub(super) struct Physics {
    data: MjData<Arc<MjModel>>,
    frame_skip: usize,
}

impl Physics {
    /// A simulation in which one control is held for `frame_skip` of the model's time steps.
    pub(super) fn new(model: Arc<MjModel>, frame_skip: usize) -> Result<Self, EnvironmentError> {
        let data = MjData::try_new(model).map_err(|error| EnvironmentError::Allocation(error.to_string()))?;
        Ok(Self { data, frame_skip })
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

    /// Starts anew from the state that `init` makes of the model's initial `(qpos, qvel)`.
    ///
    /// The accelerations are computed here as Gymnasium does after a reset: they warm-start the solver, so the first
    /// step depends on them, if by a hair.
    pub(super) fn reset(&mut self, init: impl FnOnce(&mut [f64], &mut [f64])) {
        self.data.reset();
        // SAFETY: MuJoCo allocates both arrays, apart from each other and of these lengths, for the life of `data`.
        let (qpos, qvel) = unsafe {
            let (nq, nv) = (self.data.qpos().len(), self.data.qvel().len());
            let raw = self.data.ffi_mut();
            (std::slice::from_raw_parts_mut(raw.qpos, nq), std::slice::from_raw_parts_mut(raw.qvel, nv))
        };
        init(qpos, qvel);
        self.data.forward();
    }

    /// Holds `controls` for one control period. False when the simulation diverged: MuJoCo then puts its initial state
    /// in the place of the one it could not integrate, and that is not to be taken for what the task did.
    #[must_use]
    pub(super) fn step(&mut self, controls: &[f64]) -> bool {
        self.data.ctrl_mut().copy_from_slice(controls);
        for _ in 0..self.frame_skip {
            self.data.step();
        }
        let warnings = self.data.warning();
        [MjtWarning::mjWARN_BADQPOS, MjtWarning::mjWARN_BADQVEL, MjtWarning::mjWARN_BADQACC]
            .iter()
            .all(|&warning| warnings[warning as usize].number == 0)
    }
}
