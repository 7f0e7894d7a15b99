//! Makes a policy from a snapshot.

use quad_policy::{Header, Policy, Precision, load_policy};
use quad_protocol::{Origin, Snapshot};

use super::job::JobError;

/// Most characters of an environment's name from a file in a message.
const MAX_NAME_LEN: usize = 64;

/// Loads the policy of `snapshot` for the environment `wanted`, whose sizes may be known.
pub fn load(
    snapshot: &Snapshot,
    (wanted, wanted_sizes): (&str, Option<(usize, usize)>),
    precision: Precision,
) -> Result<Box<dyn Policy>, JobError> {
    let Header { origin: Origin { environment, .. }, .. } = Header::read(&snapshot.file)?;
    let policy = load_policy(&snapshot.file, precision)?;
    let sizes = (policy.observation_dim(), policy.action_dim());
    let wanted_sizes = wanted_sizes.unwrap_or(sizes);
    if (environment.as_str(), sizes) == (wanted, wanted_sizes) {
        return Ok(policy);
    }
    let (found, wanted) = (describe(&environment, sizes), describe(wanted, wanted_sizes));
    Err(JobError::OtherEnvironment { found, wanted })
}

fn describe(name: &str, (observation_dim, action_dim): (usize, usize)) -> String {
    let name: String = name.chars().take(MAX_NAME_LEN).collect();
    format!("{name} ({observation_dim} numbers observed, {action_dim} in an action)")
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{file, smallest, snapshot};
    use super::*;

    #[test]
    fn loads_a_snapshot_only_for_its_own_environment() {
        let label = |file| {
            let loaded = load(&snapshot(file), ("hopper", Some((11, 3))), Precision::F32);
            loaded.err().map(|error| error.label())
        };
        let (mut observes_more, mut acts_more) = (smallest(), smallest());
        (observes_more.observation_dim, acts_more.action_dim) = (17, 6);
        let hopper = file("hopper", smallest(), 1);
        assert_eq!(label(hopper.clone()), None);
        for other in [
            file("walker2d", smallest(), 1),
            file(&"h".repeat(500_000), smallest(), 1),
            file("hopper", observes_more, 1),
            file("hopper", acts_more, 1),
        ] {
            assert_eq!(label(other), Some("environment"));
        }
        assert_eq!(label(hopper[..100].to_vec()), Some("tensors"));
    }
}
