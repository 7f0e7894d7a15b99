//! `evaluator probe`: compares a run's critics with true values, on this machine alone.
//!
//! `args`: the arguments; `subject`: the snapshot's networks; `states`: states that its policy visits;
//! `oracle`: true values. `noisy`: noisy actions, with the critics' gradients; `slopes`: true slopes
//! beside them; `mechanism`: statistics of these. `choosing`: statistics of candidates; `recorded`:
//! the data near them. `grid`: tables of estimates; `ranks`: rank correlation.

mod args;
mod choosing;
mod grid;
mod mechanism;
mod noisy;
mod oracle;
mod ranks;
mod recorded;
mod slopes;
mod states;
mod subject;

use std::sync::Arc;

use anyhow::Context;
use candle_core::{Device, Tensor};
use quad_dataset::DatasetError;
use quad_policy::Aggregate;
use quad_protocol::episode_seeds;
use quad_run::results::statistics::mean;
use quad_runtime::Hint;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use tracing::{info, warn};

pub(crate) use args::ProbeArgs;
use choosing::{CANDIDATES, Candidates, choosing};
use grid::Grid;
use mechanism::mechanism;
use noisy::{Noisy, normal};
use oracle::Query;
use recorded::Recorded;
use slopes::measure;
use states::State;
use subject::Probed;

/// Probes the snapshot of the command line. Returns the text to print.
pub(crate) fn probe(args: &ProbeArgs) -> anyhow::Result<String> {
    let mut probe = Probe::new(args)?;
    let tables = Vec::from_iter(probe.mechanism()?.into_iter().chain(probe.choosing()?));
    if !args.json {
        return Ok(Vec::from_iter(tables.iter().map(Grid::to_string)).join("\n"));
    }
    Ok(quad_runtime::json(&tables)?)
}

struct Probe<'a> {
    args: &'a ProbeArgs,
    probed: Probed,
    recorded: Option<Recorded>,
    states: Vec<Arc<State>>,
    /// `[n, o]`.
    observations: Tensor,
    /// Seeds of the rollouts in each state.
    seeds: Vec<Vec<u64>>,
    random: ChaCha8Rng,
}

impl<'a> Probe<'a> {
    fn new(args: &'a ProbeArgs) -> anyhow::Result<Self> {
        let probed = Probed::read(args)?;
        let recorded = recorded(args, &probed)?;
        info!("visiting {} states", args.states);
        let seeds = episode_seeds(args.seed, args.step, args.states);
        let visit = |seed: &u64| State::visit(&probed.subject, *seed).map(Arc::new);
        let states = seeds.par_iter().with_max_len(1).map(visit);
        let states = states.collect::<anyhow::Result<Vec<_>>>()?;
        let observations = states.iter().flat_map(|state| state.observation.clone()).collect();
        let shape = (states.len(), probed.subject.spec.observation_dim);
        let observations = Tensor::from_vec(observations, shape, &Device::Cpu)?;
        let mut random = ChaCha8Rng::seed_from_u64(args.seed);
        let of_state = |_| Vec::from_iter((0..args.rollouts).map(|_| random.random()));
        let seeds = (0..states.len()).map(of_state).collect();
        Ok(Self { args, probed, recorded, states, observations, seeds, random })
    }

    fn mechanism(&mut self) -> anyhow::Result<[Grid; 3]> {
        let (Probed { oracle, actor, critics, tau, delta, .. }, h) = (&self.probed, self.args.h);
        let drawn = Noisy::draw((actor, critics), &self.observations, h, &mut self.random)?;
        let (noisy, outside, scale) = drawn;
        let returns = |queries| oracle.returns(queries);
        let samples = measure(&noisy, &self.states, &self.seeds, h, returns)?;
        let weighting = (*tau, delta * scale * scale);
        Ok(mechanism(samples, self.states.len(), &outside, weighting))
    }

    fn choosing(&mut self) -> anyhow::Result<[Grid; 2]> {
        let Probed { oracle, actor, critics, .. } = &self.probed;
        let shape = actor.shape();
        let shape = (shape.diffusion_steps, self.states.len() * CANDIDATES, shape.action_dim);
        let noise = normal(shape, &mut self.random)?;
        let actions = actor.sample(&self.observations, &noise)?;
        let values = critics.values(&self.observations, &actions)?;
        let values = values.flatten_all()?.to_vec1::<f32>()?;
        let actions = actions.to_vec2::<f32>()?;
        let rules = [Aggregate::Mean, Aggregate::Min, Aggregate::MeanMinusStd(self.args.kappa)];
        let values = rules.map(|rule| {
            Vec::from_iter(rule.reduce(&values, actions.len()).into_iter().map(f64::from))
        });

        let of_states = self.states.iter().zip(&self.seeds).zip(actions.chunks_exact(CANDIDATES));
        let mut queries = Vec::new();
        for ((state, seeds), actions) in of_states {
            for action in actions {
                let query = |&seed| Query { state: state.clone(), action: action.clone(), seed };
                queries.extend(seeds.iter().map(query));
            }
        }
        let (returns, rollouts) = (oracle.returns(queries)?, self.args.rollouts as usize);
        let halves = [0..rollouts / 2, rollouts / 2..rollouts].map(|half| {
            let of_actions = returns.chunks_exact(rollouts);
            Vec::from_iter(of_actions.map(|returns| mean(&returns[half.clone()])))
        });
        let recorded = self.recorded.as_ref();
        let of_state = |(index, state): (usize, &Arc<State>)| {
            let rows = index * CANDIDATES..(index + 1) * CANDIDATES;
            let of_rows = |all: &Vec<f64>| all[rows.clone()].to_vec();
            let actions = &actions[rows.clone()];
            Candidates {
                values: values.each_ref().map(of_rows),
                halves: halves.each_ref().map(of_rows),
                distances: recorded.map(|of| of.distances(&state.observation, actions)),
            }
        };
        let candidates = Vec::from_iter(self.states.iter().enumerate().map(of_state));
        Ok(choosing(&candidates, self.args.kappa))
    }
}

/// The data, if it is there.
fn recorded(args: &ProbeArgs, probed: &Probed) -> anyhow::Result<Option<Recorded>> {
    let path = args.dataset.as_ref().unwrap_or(&probed.dataset);
    let name = path.display();
    if args.dataset.is_none() && !path.exists() {
        warn!("{name} is not there, so no distance from the data is measured");
        return Ok(None);
    }
    let recorded = Recorded::read(path, probed.subject.spec).hint_of(DatasetError::hint);
    recorded.map(Some).with_context(|| format!("cannot use {name}"))
}
