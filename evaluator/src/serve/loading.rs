//! Makes of a snapshot the policy that a job names.

use quad_dataset::environment;
use quad_policy::{Policy, PolicyError, Precision, load_policy};
use quad_protocol::{Job, Schema, Snapshot};

/// Why a snapshot does not fit the job it came for.
#[derive(Debug, thiserror::Error)]
pub enum SnapshotError {
    /// It is not the snapshot that the job names.
    #[error("the job names {field} {wanted}, the snapshot is of {found}")]
    Other {
        /// The field that differs.
        field: &'static str,
        /// Its value in the job.
        wanted: String,
        /// Its value in the snapshot.
        found: String,
    },
    /// Its schema is not that of a policy for the environment.
    #[error("the snapshot's {field} is {found}, but the environment's is {wanted}")]
    Schema {
        /// Name within the schema.
        field: &'static str,
        /// Its value.
        found: u32,
        /// The environment's.
        wanted: usize,
    },
    /// This evaluator does not know the environment.
    #[error("no environment {0} here")]
    Environment(String),
    /// Its tensors are another policy than its schema says.
    #[error("the snapshot says {field} {claimed}, but its tensors say {found}")]
    Tensors {
        /// Name within the schema.
        field: &'static str,
        /// Its value.
        claimed: String,
        /// What the tensors say.
        found: String,
    },
    /// Its tensors are no policy.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

impl SnapshotError {
    /// The reason as a metric's label.
    pub fn label(&self) -> &'static str {
        match self {
            SnapshotError::Other { .. } => "other_snapshot",
            SnapshotError::Schema { .. } | SnapshotError::Environment(_) => "schema",
            SnapshotError::Tensors { .. } | SnapshotError::Policy(_) => "tensors",
        }
    }
}

/// Loads the policy of `snapshot` if it is exactly the one that `job` names. Its hash was verified by the codec.
pub fn policy_for(job: &Job, snapshot: &Snapshot, precision: Precision) -> Result<Box<dyn Policy>, SnapshotError> {
    same("run", &job.run, &snapshot.run)?;
    same("incarnation", &job.incarnation, &snapshot.incarnation)?;
    same("step", &job.step, &snapshot.step)?;
    same("hash", &job.weights, &snapshot.hash)?;
    same("environment", &job.environment, &snapshot.schema.environment)?;
    suits_environment(&snapshot.schema)?;
    let policy = load_policy(&snapshot.tensors, precision)?;
    is_as_claimed(&snapshot.schema, policy.as_ref())?;
    Ok(policy)
}

fn same<T: PartialEq + ToString>(field: &'static str, wanted: &T, found: &T) -> Result<(), SnapshotError> {
    if wanted == found {
        return Ok(());
    }
    Err(SnapshotError::Other { field, wanted: wanted.to_string(), found: found.to_string() })
}

/// Checks the schema's sizes against its environment.
fn suits_environment(schema: &Schema) -> Result<(), SnapshotError> {
    let spec =
        environment::find(&schema.environment).map_err(|_| SnapshotError::Environment(schema.environment.clone()))?;
    for (field, found, wanted) in [
        ("observation_dim", schema.observation_dim, spec.observation_dim),
        ("action_dim", schema.action_dim, spec.action_dim),
    ] {
        if found as usize != wanted {
            return Err(SnapshotError::Schema { field, found, wanted });
        }
    }
    Ok(())
}

/// Checks the policy that the tensors gave against what the schema says of them.
fn is_as_claimed(schema: &Schema, policy: &dyn Policy) -> Result<(), SnapshotError> {
    let claims = [
        ("policy", schema.policy.clone(), policy.kind().to_owned()),
        ("observation_dim", schema.observation_dim.to_string(), policy.observation_dim().to_string()),
        ("action_dim", schema.action_dim.to_string(), policy.action_dim().to_string()),
    ];
    for (field, claimed, found) in claims {
        if claimed != found {
            return Err(SnapshotError::Tensors { field, claimed, found });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device, Tensor};
    use quad_policy::{Description, DiffusionPolicy, DiffusionShape, Ensemble, Layout, NoisePredictor, Weights};
    use quad_protocol::{Hash, Lease, Name};

    use super::*;

    /// A diffusion policy whose weights are all zero.
    fn tensors(observation_dim: usize, action_dim: usize) -> Vec<u8> {
        let shape = DiffusionShape { observation_dim, action_dim, hidden: 8, critics: 2, diffusion_steps: 5 };
        let zeros = |layout: Layout| {
            let values = Tensor::zeros(layout.count(), DType::F32, &Device::Cpu).unwrap();
            Weights::constant(layout, values)
        };
        let actor = NoisePredictor::new(shape.actor(), zeros(shape.actor().layout()), Precision::F32);
        let critics = Ensemble::new(shape.critics(), zeros(shape.critics().layout()), Precision::F32);
        let tensors = DiffusionPolicy::tensors(&actor, &critics).unwrap();
        Description::Diffusion(shape).to_safetensors(&tensors).unwrap()
    }

    fn job_and_snapshot() -> (Job, Snapshot) {
        let run = Name::new("run").unwrap();
        let tensors = tensors(11, 3);
        let weights = Hash::of(&tensors);
        let schema = Schema {
            environment: "hopper".to_owned(),
            observation_dim: 11,
            action_dim: 3,
            policy: "diffusion".to_owned(),
        };
        let job = Job {
            id: 1,
            lease: Lease::random(),
            run: run.clone(),
            incarnation: 3,
            step: 100,
            weights,
            environment: "hopper".to_owned(),
            instance: 1,
            seeds: vec![1],
            candidates: 1,
            progress_milliseconds: 300,
        };
        (job, Snapshot { run, incarnation: 3, step: 100, schema, hash: weights, tensors })
    }

    fn label(change: impl Fn(&mut Job, &mut Snapshot)) -> &'static str {
        let (mut job, mut snapshot) = job_and_snapshot();
        change(&mut job, &mut snapshot);
        policy_for(&job, &snapshot, Precision::F32).err().unwrap().label()
    }

    #[test]
    fn only_the_snapshot_that_the_job_names_is_used() {
        let (job, snapshot) = job_and_snapshot();
        assert!(policy_for(&job, &snapshot, Precision::F32).is_ok());
        assert_eq!(label(|job, _| job.run = Name::new("other").unwrap()), "other_snapshot");
        assert_eq!(label(|job, _| job.incarnation += 1), "other_snapshot");
        assert_eq!(label(|job, _| job.step += 1), "other_snapshot");
        assert_eq!(label(|job, _| job.weights = Hash::of(b"others")), "other_snapshot");
        assert_eq!(label(|job, _| job.environment = "walker2d".to_owned()), "other_snapshot");
    }

    #[test]
    fn a_schema_that_does_not_suit_the_environment_is_refused() {
        assert_eq!(label(|_, snapshot| snapshot.schema.observation_dim = 17), "schema");
        assert_eq!(label(|_, snapshot| snapshot.schema.action_dim = 6), "schema");
        let moon = |job: &mut Job, snapshot: &mut Snapshot| {
            job.environment = "moon".to_owned();
            snapshot.schema.environment = "moon".to_owned();
        };
        assert_eq!(label(moon), "schema");
    }

    #[test]
    fn tensors_that_are_another_policy_than_the_schema_says_are_refused() {
        assert_eq!(label(|_, snapshot| snapshot.schema.policy = "gaussian".to_owned()), "tensors");
        assert_eq!(label(|_, snapshot| snapshot.tensors = tensors(17, 3)), "tensors");
        assert_eq!(label(|_, snapshot| snapshot.tensors = tensors(11, 6)), "tensors");
        assert_eq!(label(|_, snapshot| snapshot.tensors.truncate(100)), "tensors");
    }
}
