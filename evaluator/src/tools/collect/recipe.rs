//! What differs between environments: how much search the recording needs, and which episodes it keeps.

use quad_dataset::EnvironmentSpec;

/// How a dataset of one environment is recorded.
#[derive(Debug)]
pub struct Recipe {
    environment: &'static str,
    /// Independent searches. Each finds its own gait, so that the recorded actions in a state differ by more than noise.
    pub searches: u64,
    /// Steps that the searches may take per recorded transition, for up to [`MOST_TRANSITIONS`] transitions.
    steps_per_transition: u64,
    /// Bands of normalised score: the lower bound of each, and its share of the transitions.
    ///
    /// Without shares, a search's history is mostly long, good episodes, from which offline learning can gain little. The
    /// shares make a mixture with any seed: good actions exist, among worse ones in the same states.
    pub mixture: &'static [(f64, f64)],
}

/// With this many transitions most searches move well, after a minute on two cores.
const MOST_TRANSITIONS: u64 = 100_000;

/// The environments that linear policies learn to move in.
static RECIPES: [Recipe; 3] = [
    Recipe {
        environment: "hopper",
        // One search in three or four takes long to find any gait.
        searches: 8,
        steps_per_transition: 16,
        // A third of the transitions, but nearly nine in ten episodes, fall over soon and pull the mean score down to about 8;
        // most other episodes hop for a while; and one in ten shows how far a gait can be taken.
        mixture: &[(f64::NEG_INFINITY, 0.22), (3.0, 0.15), (10.0, 0.2), (30.0, 0.2), (50.0, 0.13), (80.0, 0.1)],
    },
    Recipe {
        environment: "halfcheetah",
        // All episodes have a thousand steps, so an iteration takes sixteen thousand; but steps are fast.
        searches: 4,
        steps_per_transition: 48,
        mixture: &[(f64::NEG_INFINITY, 0.25), (5.0, 0.25), (12.0, 0.25), (20.0, 0.25)],
    },
    Recipe {
        environment: "walker2d",
        searches: 6,
        steps_per_transition: 20,
        mixture: &[(f64::NEG_INFINITY, 0.25), (3.0, 0.2), (8.0, 0.25), (15.0, 0.2), (25.0, 0.1)],
    },
];

impl Recipe {
    /// The recipe of an environment; none for a maze, which linear policies cannot solve.
    pub fn of(spec: &EnvironmentSpec) -> Option<&'static Self> {
        RECIPES.iter().find(|recipe| recipe.environment == spec.name)
    }

    /// Environment steps that the searches may take together to record `transitions`.
    pub fn search_steps(&self, transitions: usize) -> u64 {
        self.steps_per_transition * (transitions as u64).min(MOST_TRANSITIONS)
    }

    /// The environments that have a recipe.
    pub fn environments() -> String {
        RECIPES.each_ref().map(|recipe| recipe.environment).join(", ")
    }
}
