//! The choice among candidates, judged by their true values.

use candle_core::Tensor;
use quad_policy::Aggregate;
use quad_run::results::statistics::mean;
use rand::Rng;

use super::grid::Grid;
use super::noisy::normal;
use super::oracle::Query;
use super::ranks::rank_correlation;
use super::recorded::Recorded;
use super::states::State;
use super::subject::Probed;

/// Candidates of a state.
const CANDIDATES: usize = 32;

/// The candidates of one state.
pub struct Candidates {
    /// Values by the mean, the minimum and the mean − κ·std over critics.
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
        kappa: f32,
        random: &mut impl Rng,
    ) -> anyhow::Result<Vec<Self>> {
        let shape = actor.shape();
        let shape = (shape.diffusion_steps, states.len() * CANDIDATES, shape.action_dim);
        let actions = actor.sample(observations, &normal(shape, random)?)?;
        let values = critics.values(observations, &actions)?.flatten_all()?.to_vec1::<f32>()?;
        let actions = actions.to_vec2::<f32>()?;
        let rules = [Aggregate::Mean, Aggregate::Min, Aggregate::MeanMinusStd(kappa)];
        let values = rules.map(|rule| {
            Vec::from_iter(rule.reduce(&values, actions.len()).into_iter().map(f64::from))
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

    /// Choices among `count`, in all groups of so many: the mean true value above that of a group's
    /// mean candidate; the mean below that of its best one by one half of the rollouts, valued by
    /// the other; and the mean distance.
    fn choose(&self, rule: usize, count: usize) -> [f64; 3] {
        let (truth, groups) = (self.truth(), CANDIDATES / count);
        let mut sums = [0.0; 3];
        for first in (0..groups).map(|group| group * count) {
            let group = first..first + count;
            let chosen = first + largest(&self.values[rule][group.clone()]);
            let regret = |by: usize| {
                let best = first + largest(&self.halves[by][group.clone()]);
                self.halves[1 - by][best] - self.halves[1 - by][chosen]
            };
            sums[0] += truth[chosen] - mean(&truth[group.clone()]);
            sums[1] += (regret(0) + regret(1)) / 2.0;
            sums[2] += self.distances.as_ref().map_or(0.0, |distances| distances[chosen]);
        }
        sums.map(|sum| sum / groups as f64)
    }
}

/// Tables of rank correlations and of choices.
pub fn choosing(states: &[Candidates], kappa: f32) -> [Grid; 2] {
    let rules = ["mean".to_owned(), "minimum".to_owned(), format!("mean − {kappa}·std")];
    let correlations = |state: &Candidates| {
        let halves = rank_correlation(&state.halves[0], &state.halves[1]);
        let of_rules = state.values.iter().map(|values| rank_correlation(values, &state.truth()));
        [halves].into_iter().chain(of_rules).collect()
    };
    let mut columns = vec!["above the mean candidate", "regret", "distance from the data"];
    columns.truncate(if states.iter().all(|state| state.distances.is_some()) { 3 } else { 2 });
    let of_rules = (0..rules.len()).flat_map(|rule| [2, 5, 10, CANDIDATES].map(|n| (rule, n)));
    let choices = Vec::from_iter([(0, 1)].into_iter().chain(of_rules));
    let chosen = |state: &Candidates| {
        let of_choice = |(rule, count)| state.choose(rule, count).into_iter().take(columns.len());
        choices.iter().copied().flat_map(of_choice).collect()
    };
    let names = ["the other half of the rollouts".to_owned()];
    let names = names.into_iter().chain(rules.iter().map(|rule| format!("the critics' {rule}")));
    let of_choice = choices.iter().map(|(rule, count)| match count {
        1 => "one candidate".to_owned(),
        _ => format!("largest {} of {count}", rules[*rule]),
    });
    let correlation = ["rank correlation with the truth"];
    [
        means("Values of 32 candidates", &correlation, names, states, correlations),
        means("Choices among candidates", &columns, of_choice, states, chosen),
    ]
}

/// A table of means over states.
fn means(
    title: &'static str,
    columns: &[&'static str],
    names: impl IntoIterator<Item = String>,
    states: &[Candidates],
    numbers: impl Fn(&Candidates) -> Vec<f64>,
) -> Grid {
    let by_state = Vec::from_iter(states.iter().map(numbers));
    let column =
        |drawn: &[usize], at| mean(&Vec::from_iter(drawn.iter().map(|i| by_state[*i][at])));
    Grid::of(title, columns, names, states.len(), |drawn| {
        (0..by_state[0].len()).map(|at| column(drawn, at)).collect()
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
        let [correlations, choices] = choosing(&[state], 1.0);
        let values = |grid: &Grid, row: usize| {
            Vec::from_iter(grid.rows[row].1.iter().map(|number| number.value))
        };
        assert_eq!(values(&choices, 0), [0.0, 0.0, 31.0 / 16.0]);
        assert_eq!(values(&choices, 12), [23.25, 0.0, 31.0 / 8.0]);
        assert_eq!([0, 2, 3].map(|row| values(&correlations, row)[0].round()), [1.0, -1.0, 1.0]);
    }
}
