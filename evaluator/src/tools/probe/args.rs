//! The arguments of `evaluator probe`.

use std::path::PathBuf;

use anyhow::anyhow;
use clap::{Args, ValueEnum, value_parser};
use quad_runtime::Hint;

/// Compare a run's critics with true values, which the simulator gives
///
/// States are drawn from new episodes of the run's policy, one from each. An action's true value is
/// the mean discounted return, in the critics' units, of rollouts that begin with the action and
/// then take one sample of the policy in each state. The critics' targets value the same policy, up
/// to ρ and `target_reduce = "max"`. Rollouts of a state's actions share their noise.
/// docs/operations.md explains the tables.
#[derive(Args, Debug)]
pub struct ProbeArgs {
    /// Folder of a run of QUAD or one of its variants
    #[arg(value_name = "RUN")]
    pub run: PathBuf,
    /// Gradient step of the snapshot
    #[arg(long, value_name = "N")]
    pub step: u64,
    /// Number of states
    #[arg(long, value_name = "N", default_value = "64", value_parser = value_parser!(u32).range(2..))]
    pub states: u32,
    /// Rollouts of each action
    #[arg(long, value_name = "N", default_value = "16", value_parser = value_parser!(u32).range(2..))]
    pub rollouts: u32,
    /// Most steps of a rollout. Fewer miss what an action changes later, such as a fall; more are noisier
    #[arg(long, value_name = "N", default_value = "400", value_parser = value_parser!(u32).range(1..))]
    pub length: u32,
    /// Change of an action to either side, of which slopes are central differences [default: 0.1]
    #[arg(long, value_name = "X", value_parser = change)]
    pub h: Option<f32>,
    /// Tables to make [default: all]
    #[arg(long, value_enum)]
    pub tables: Option<Tables>,
    /// Dataset to which the distance of chosen actions is measured [default: the run's, if it is
    /// there]
    #[arg(long, value_name = "PATH")]
    pub dataset: Option<PathBuf>,
    /// Seed of states and noise
    #[arg(long, value_name = "N", default_value = "0")]
    pub seed: u64,
    /// Print the tables as JSON
    #[arg(long)]
    pub json: bool,
}

impl ProbeArgs {
    /// Refuses an option that only tables use which are not made.
    pub fn check(&self) -> anyhow::Result<()> {
        let (option, tables) = match self.tables {
            Some(Tables::Choices) if self.h.is_some() => ("--h", "gradients"),
            Some(Tables::Gradients) if self.dataset.is_some() => ("--dataset", "choices"),
            _ => return Ok(()),
        };
        Err(anyhow!("{option} changes nothing without the tables of {tables}"))
            .hint("leave it out, or --tables")
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Tables {
    /// The critics' gradients at noisy actions
    Gradients,
    /// The choice among candidates
    Choices,
}

fn change(text: &str) -> Result<f32, &'static str> {
    let number = text.parse().ok().filter(|h: &f32| *h > 0.0 && *h < 1.0);
    number.ok_or("a number between 0 and 1")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_that_give_no_slope_are_refused() {
        assert!(["0", "1", "nan", "x"].iter().all(|text| change(text).is_err()));
        assert_eq!(change("0.5"), Ok(0.5));
    }
}
