//! `evaluator probe`: compares a run's critics with true values, on this machine alone.
//!
//! `args`: the arguments; `subject`: the snapshot's networks; `states`: states that its policy visits;
//! `oracle`: true values. `noisy`: noisy actions, with the critics' gradients; `slopes`: true slopes
//! beside them; `mechanism`: statistics of these. `choosing`: candidates, and statistics of them;
//! `recorded`: the data near them. `grid`: tables of estimates; `ranks`: rank correlation.

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

use anyhow::Context;
use candle_core::{Device, Tensor};
use quad_dataset::DatasetError;
use quad_protocol::episode_seeds;
use quad_runtime::Hint;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use tracing::{info, warn};

pub(crate) use args::ProbeArgs;
use args::Tables;
use choosing::{Candidates, choosing};
use grid::Grid;
use mechanism::mechanism;
use recorded::Recorded;
use slopes::measure;
use states::State;
use subject::Probed;

/// The change of an action of which slopes are taken, without `--h`.
const CHANGE: f32 = 0.1;

/// Probes the snapshot of the command line. Returns the text to print.
pub(crate) fn probe(args: &ProbeArgs) -> anyhow::Result<String> {
    args.check()?;
    let probed = Probed::read(args)?;
    let recorded = match args.tables {
        Some(Tables::Gradients) => None,
        _ => recorded(args, &probed)?,
    };
    info!("visiting {} states", args.states);
    let seeds = episode_seeds(args.seed, args.step, args.states);
    let visited = seeds.par_iter().with_max_len(1).map(|seed| State::visit(&probed.subject, *seed));
    let mut states = visited.collect::<anyhow::Result<Vec<_>>>()?;
    let random = &mut ChaCha8Rng::seed_from_u64(args.seed);
    for state in &mut states {
        state.rollouts.extend((0..args.rollouts).map(|_| random.random::<u64>()));
    }
    let observations = states.iter().flat_map(|state| state.observation.clone()).collect();
    let shape = (states.len(), probed.subject.spec.observation_dim);
    let observations = Tensor::from_vec(observations, shape, &Device::Cpu)?;

    let Probed { oracle, actor, critics, tau, delta, .. } = &probed;
    let mut tables = Vec::new();
    if args.tables != Some(Tables::Choices) {
        let h = args.h.unwrap_or(CHANGE);
        let (noisy, outside, scale) = noisy::draw((actor, critics), &observations, h, random)?;
        let samples = measure(&noisy, &states, h, |queries| oracle.returns(queries))?;
        let weighting = (*tau, delta * scale * scale);
        tables.extend(mechanism(samples, states.len(), &outside, weighting));
    }
    if args.tables != Some(Tables::Gradients) {
        let recorded = recorded.as_ref();
        let candidates = Candidates::draw(&probed, &states, &observations, recorded, random)?;
        tables.extend(choosing(&candidates));
    }
    if args.json {
        return Ok(quad_runtime::json(&tables)?);
    }
    Ok(Vec::from_iter(tables.iter().map(Grid::to_string)).join("\n"))
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
