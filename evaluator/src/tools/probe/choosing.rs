//! The choice among candidates, judged by their true values.

use candle_core::Tensor;
use quad_policy::Aggregate;
use quad_run::results::statistics::mean;
use rand::Rng;

use super::grid::{Grid, means};
use super::noisy::normal;
use super::oracle::Query;
use super::ranks::rank_correlation;
use super::recorded::Recorded;
use super::states::State;
use super::subject::Probed;

/// Candidates of a state.
const CANDIDATES: usize = 32;
/// Aggregates of the critics' values by which candidates are chosen.
const AGGREGATES: [(Aggregate, &str); 3] = [
    (Aggregate::Mean, "mean"),
    (Aggregate::Min, "minimum"),
    (Aggregate::MeanMinusStd(1.0), "mean − 1·std"),
];

/// The candidates of one state.
pub struct Candidates {
    /// The critics' values by each of `AGGREGATES`.
    pub values: [Vec<f64>; 3],
    /// True values, each a mean over one half of the rollouts.
    pub halves: [Vec<f64>; 2],
    /// Distances to the nearest action that was recorded in similar states.
    pub distances: Option<Vec<f64>>,
}

/// Index of the largest number, the first of equals.
fn largest(values: &[f64]) -> usize {
    (1..values.len()).fold(0, |best, i| if values[i] > values[best] { i } else { best })
}

impl Candidates {
    /// Draws candidates in each of n states, whose `observations` are `[n, o]`, and measures them.
    pub fn draw(
        Probed { actor, critics, oracle, .. }: &Probed,
        states: &[State],
        observations: &Tensor,
        recorded: Option<&Recorded>,
        random: &mut impl Rng,
    ) -> anyhow::Result<Vec<Self>> {
        let shape = actor.shape();
        let shape = (shape.diffusion_steps, states.len() * CANDIDATES, shape.action_dim);
        let actions = actor.sample(observations, &normal(shape, random)?)?;
        let values = critics.values(observations, &actions)?.flatten_all()?.to_vec1::<f32>()?;
        let actions = actions.to_vec2::<f32>()?;
        let values = AGGREGATES.map(|(aggregate, _)| {
            Vec::from_iter(aggregate.reduce(&values, actions.len()).into_iter().map(f64::from))
        });

        let mut queries = Vec::new();
        for (state, actions) in states.iter().zip(actions.chunks_exact(CANDIDATES)) {
            for action in actions {
                let query = |&seed| Query { state, action: action.clone(), seed };
                queries.extend(state.rollouts.iter().map(query));
            }
        }
        let (returns, rollouts) = (oracle.returns(&queries)?, states[0].rollouts.len());
        let halves = [0..rollouts / 2, rollouts / 2..rollouts].map(|half| {
            let of_actions = returns.chunks_exact(rollouts);
            Vec::from_iter(of_actions.map(|returns| mean(&returns[half.clone()])))
        });
        let of_state = |(index, state): (usize, &State)| {
            let rows = index * CANDIDATES..(index + 1) * CANDIDATES;
            let of_rows = |all: &Vec<f64>| all[rows.clone()].to_vec();
            Self {
                values: values.each_ref().map(of_rows),
                halves: halves.each_ref().map(of_rows),
                distances: recorded.map(|of| of.distances(&state.observation, &actions[rows])),
            }
        };
        Ok(states.iter().enumerate().map(of_state).collect())
    }

    fn truth(&self) -> Vec<f64> {
        let [one, other] = &self.halves;
        one.iter().zip(other).map(|(one, other)| (one + other) / 2.0).collect()
    }

    /// Splits the candidates into groups of `count` and chooses one of each by one of `AGGREGATES`.
    /// Means over the groups: the choice's true value above the group's mean; its true value below
    /// that of the group's best, which one half of the rollouts finds and the other values; and its
    /// distance.
    fn choose(&self, aggregate: usize, count: usize) -> Vec<f64> {
        let truth = self.truth();
        let in_group = |first: usize| {
            let group = first..first + count;
            let chosen = first + largest(&self.values[aggregate][group.clone()]);
            let regret = |by: usize| {
                let best = first + largest(&self.halves[by][group.clone()]);
                self.halves[1 - by][best] - self.halves[1 - by][chosen]
            };
            let gain = truth[chosen] - mean(&truth[group.clone()]);
            let distance = self.distances.as_ref().map(|distances| distances[chosen]);
            let numbers = [gain, (regret(0) + regret(1)) / 2.0];
            Vec::from_iter(numbers.into_iter().chain(distance))
        };
        let groups = (0..CANDIDATES / count).map(|group| in_group(group * count));
        means(&Vec::from_iter(groups))
    }
}

/// Tables of rank correlations and of choices.
pub fn choosing(states: &[Candidates]) -> [Grid; 2] {
    let row = |name: String, numbers: &dyn Fn(&Candidates) -> Vec<f64>| {
        (name, Vec::from_iter(states.iter().map(numbers)))
    };
    let mut correlations = vec![row("the other half of the rollouts".to_owned(), &|state| {
        vec![rank_correlation(&state.halves[0], &state.halves[1])]
    })];
    let mut choices = vec![row("one candidate".to_owned(), &|state| state.choose(0, 1))];
    for (aggregate, (_, name)) in AGGREGATES.iter().enumerate() {
        correlations.push(row(format!("the critics' {name}"), &|state| {
            vec![rank_correlation(&state.values[aggregate], &state.truth())]
        }));
        for count in [2, 5, 10, CANDIDATES] {
            let name = format!("largest {name} of {count}");
            choices.push(row(name, &|state| state.choose(aggregate, count)));
        }
    }
    let columns = ["above the mean candidate", "regret", "distance from the data"];
    let known = if states[0].distances.is_some() { 3 } else { 2 };
    [
        table("Values of 32 candidates", &["rank correlation with the truth"], correlations),
        table("Choices among candidates", &columns[..known], choices),
    ]
}

/// A table of means over states. A row has a name, and its numbers in each state.
fn table(
    title: &'static str,
    columns: &[&'static str],
    rows: Vec<(String, Vec<Vec<f64>>)>,
) -> Grid {
    let states = Vec::from_iter(0..rows[0].1.len());
    let names = rows.iter().map(|(name, _)| name.clone());
    Grid::of(title, columns, names, &states, |drawn| {
        let of_drawn = |numbers: &[Vec<f64>]| {
            means(&Vec::from_iter(drawn.iter().map(|state| &numbers[**state])))
        };
        rows.iter().flat_map(|(_, numbers)| of_drawn(numbers)).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One half of the rollouts says 0, 1, 2, …, 31, the other the double, and so do the critics, but
    /// that their mean takes 0, 10, 20 and 30 for the best, in this order.
    #[test]
    fn choices_are_judged_by_the_truth() {
        let numbers = |of: fn(f64) -> f64| Vec::from_iter((0..32).map(|i| of(f64::from(i))));
        let state = Candidates {
            values: [
                numbers(|i| if i % 10.0 == 0.0 { 100.0 - i } else { i }),
                numbers(|i| -i),
                numbers(|i| i),
            ],
            halves: [numbers(|i| i), numbers(|i| 2.0 * i)],
            distances: Some(numbers(|i| i / 8.0)),
        };
        // The first of ten is 4.5 below their mean in one half and 9 in the other.
        assert_eq!(state.choose(0, 10), [-6.75, 13.5, 1.25]);
        assert_eq!(state.choose(0, 32), [-23.25, 46.5, 0.0]);
        assert_eq!(state.choose(2, 2), [0.75, 0.0, 2.0]);
        let [correlations, choices] = choosing(&[state]);
        let values = |grid: &Grid, row: usize| {
            Vec::from_iter(grid.rows[row].1.iter().map(|number| number.value))
        };
        assert_eq!(values(&choices, 0), [0.0, 0.0, 31.0 / 16.0]);
        assert_eq!(values(&choices, 12), [23.25, 0.0, 31.0 / 8.0]);
        assert_eq!([0, 2, 3].map(|row| values(&correlations, row)[0].round()), [1.0, -1.0, 1.0]);
    }
}
