//! Makes of a snapshot the policy that acts in a job's environment.

use quad_dataset::EnvironmentSpec;
use quad_policy::{Policy, PolicyError, Precision, load_policy};
use quad_protocol::Snapshot;

/// Why a snapshot is no policy for an environment.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// It says that it is for another environment, or has other sizes.
    #[error("the snapshot is for {found}, the job's environment is {wanted}")]
    Schema {
        /// What the snapshot says of its environment.
        found: String,
        /// What it would have to say.
        wanted: String,
    },
    /// Its tensors are another policy than it says.
    #[error("the snapshot says that it is a {claimed}, but its tensors are a {found}")]
    Tensors {
        /// What the snapshot says of its policy.
        claimed: String,
        /// What its tensors are.
        found: String,
    },
    /// Its tensors are no policy.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

impl LoadError {
    /// The reason as a metric's label.
    pub fn label(&self) -> &'static str {
        match self {
            LoadError::Schema { .. } => "schema",
            LoadError::Tensors { .. } | LoadError::Policy(_) => "tensors",
        }
    }
}

/// Loads the policy of `snapshot`, which is to act in the environment `spec`.
pub fn load(snapshot: &Snapshot, spec: &EnvironmentSpec, precision: Precision) -> Result<Box<dyn Policy>, LoadError> {
    let schema = &snapshot.schema;
    let sizes = (schema.observation_dim as usize, schema.action_dim as usize);
    let found = described(&schema.environment, sizes);
    let wanted = described(&spec.name, (spec.observation_dim, spec.action_dim));
    if found != wanted {
        return Err(LoadError::Schema { found, wanted });
    }
    let policy = load_policy(&snapshot.tensors, precision)?;
    let claimed = described(&schema.policy, sizes);
    let found = described(policy.kind(), (policy.observation_dim(), policy.action_dim()));
    if found != claimed {
        return Err(LoadError::Tensors { claimed, found });
    }
    Ok(policy)
}

/// An environment or a kind of policy, with its sizes.
fn described(name: &str, (observation_dim, action_dim): (usize, usize)) -> String {
    format!("{name} ({observation_dim} numbers observed, {action_dim} in an action)")
}

#[cfg(test)]
mod tests {
    use quad_dataset::environment::find;
    use quad_policy::DiffusionShape;

    use super::super::fixtures::{SMALLEST, snapshot, tensors};
    use super::*;

    /// Why a snapshot for Hopper with this change is refused.
    fn label(change: impl Fn(&mut Snapshot)) -> Option<&'static str> {
        let mut snapshot = snapshot(tensors(SMALLEST));
        change(&mut snapshot);
        load(&snapshot, find("hopper").unwrap(), Precision::F32).err().map(|error| error.label())
    }

    #[test]
    fn a_snapshot_is_loaded_only_for_its_own_environment() {
        assert_eq!(label(|_| ()), None);
        assert_eq!(label(|snapshot| snapshot.schema.environment = "walker2d".to_owned()), Some("schema"));
        assert_eq!(label(|snapshot| snapshot.schema.observation_dim = 17), Some("schema"));
        assert_eq!(label(|snapshot| snapshot.schema.action_dim = 6), Some("schema"));
    }

    #[test]
    fn tensors_that_are_another_policy_than_the_snapshot_says_are_refused() {
        let (observes_more, acts_more) =
            (DiffusionShape { observation_dim: 17, ..SMALLEST }, DiffusionShape { action_dim: 6, ..SMALLEST });
        assert_eq!(label(|snapshot| snapshot.schema.policy = "gaussian".to_owned()), Some("tensors"));
        assert_eq!(label(|snapshot| snapshot.tensors = tensors(observes_more)), Some("tensors"));
        assert_eq!(label(|snapshot| snapshot.tensors = tensors(acts_more)), Some("tensors"));
        assert_eq!(label(|snapshot| snapshot.tensors.truncate(100)), Some("tensors"));
    }
}
