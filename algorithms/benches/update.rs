//! Gradient steps of every algorithm at Hopper's shapes, QUAD's also in parts, and the machine's
//! peaks at these shapes, which bound them. `deploy/bench.sh` makes a table of the results.

#![allow(clippy::expect_used)] // a benchmark that cannot run panics

use candle_core::{Device, Result, Tensor};
use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, Criterion, criterion_group};
use quad_algorithms::{ALGORITHMS, Agent, Context, Definition, Values};
use quad_dataset::{Arrays, Transitions, Window};
use quad_kernels::activation::{Activation, activate, activate_with_slope};
use quad_kernels::product::{Matrix::RowMajor, by_gemm};
use quad_nn::{
    Adam, AdamStep, Ensemble, Gradients, Layout, NoisePredictor, Precision, Weighted, Weights,
    open_gpu, squared_error,
};
use quad_policy::DiffusionShape;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::sync::Arc;
use std::time::Duration;
use toml::Table;

/// Hopper's observation and action.
const DIMS: (usize, usize) = (11, 3);

/// The task whose values all algorithms but QUAD are measured with.
const TASK: &str = "hopper-medium-v2";

/// The task of QUAD's configurations.
const PAPER: &str = "hopper-medium-replay-v2";

/// A value in place of the task's.
type Change = Option<(&'static str, u32)>;

/// Other configurations that are measured: task, algorithm, and a value in place of the task's.
/// deploy/bench/bench.py knows QUAD's shapes; algorithms/benches/jax_step.py names all as they are
/// named here.
const CONFIGURATIONS: [(&str, [&str; 2], Change); 5] = [
    ("paper, 10 samples", [PAPER, "quad"], Some(("samples", 10))),
    ("paper, 1 sample", [PAPER, "quad"], Some(("samples", 1))),
    ("demo", ["hopper-demo", "quad"], Some(("samples", 1))),
    ("demo, IQL", ["hopper-demo", "iql"], None),
    ("qc-fql", [TASK, "fql"], Some(("chunk", 5))),
];

/// An algorithm with its values for a task.
struct Experiment {
    definition: Definition,
    agent: Table,
    batch_size: usize,
    total_steps: u64,
}

fn experiment([task, algorithm]: [&str; 2], change: Change) -> Experiment {
    let definition = *ALGORITHMS.iter().find(|row| row.name == algorithm).expect("an algorithm");
    let mut values = Values::read(&definition).for_task(Some(task));
    let Some(toml::Value::Table(mut agent)) = values.remove("agent") else {
        panic!("no values for {task}")
    };
    agent.extend(change.map(|(key, value)| (key.to_owned(), value.into())));
    let number = |name: &str| values[name].as_integer().expect("a whole number");
    let (batch_size, total_steps) = (number("batch_size") as usize, number("steps") as u64);
    Experiment { definition, agent, batch_size, total_steps }
}

fn numbers(len: usize) -> Vec<f32> {
    let mut generator = ChaCha8Rng::seed_from_u64(len as u64);
    (0..len).map(|_| generator.random_range(-1.0..1.0)).collect()
}

fn tensor(shape: &[usize]) -> Tensor {
    let numbers = numbers(shape.iter().product());
    Tensor::from_vec(numbers, shape, &Device::Cpu).expect("a tensor")
}

/// One episode.
fn transitions(count: usize) -> Transitions {
    let observations = numbers((count + 1) * DIMS.0);
    let arrays = Arrays {
        observation_dim: DIMS.0,
        action_dim: DIMS.1,
        observations: observations[..count * DIMS.0].to_vec(),
        actions: numbers(count * DIMS.1),
        rewards: numbers(count),
        next_observations: observations[DIMS.0..].to_vec(),
        terminals: vec![false; count],
        timeouts: (1..=count).map(|row| row == count).collect(),
    };
    Transitions::of(arrays).expect("numbers that can be learned from")
}

fn updates(criterion: &mut Criterion) {
    let mut groups = vec![("update", Device::Cpu, Precision::F32)];
    if Precision::Bf16.is_available() {
        groups.push(("update, bf16", Device::Cpu, Precision::Bf16));
    }
    // An update ends with its numbers on the host, so that nothing of it is left for the GPU to do.
    if cfg!(feature = "cuda") {
        groups.push(("update on cuda", open_gpu().expect("a GPU"), Precision::F32));
    }
    for (group, device, precision) in groups {
        let mut group = criterion.benchmark_group(group);
        group.sample_size(20);
        let names = ALGORITHMS.iter().map(|definition| definition.name);
        let baselines = names.filter(|name| *name != "quad");
        let baselines = baselines.map(|name| (name, [TASK, name], None));
        for (name, which, change) in CONFIGURATIONS.into_iter().chain(baselines) {
            let experiment = experiment(which, change);
            let transitions = Arc::new(transitions(2 * experiment.batch_size));
            let context = Context {
                transitions: transitions.clone(),
                total_steps: experiment.total_steps,
                online_steps: 0,
                window: Window::ONE,
                seed: 0,
                precision,
                device: device.clone(),
            };
            let mut agent = Agent::new(experiment.definition, &experiment.agent, context)
                .expect("usable values");
            let examples = agent.examples(transitions).expect("examples");
            let indices: Vec<u32> =
                (0..experiment.batch_size).map(|i| (i % examples.len()) as u32).collect();
            let phases = agent.phases();
            for (i, start) in phases.iter().enumerate() {
                agent.skip_to(*start);
                let name = if phases.len() == 1 {
                    name.to_owned()
                } else {
                    format!("{name}, phase {}", i + 1)
                };
                group.bench_function(name, |bencher| {
                    bencher.iter(|| {
                        let batch = examples.batch(&indices).expect("a batch");
                        agent.update(&batch).expect("a step")
                    })
                });
            }
        }
        group.finish();
    }
}

/// Products and activations per second, on all threads: 1000 tiles of 128 × 256 on each.
fn peaks(criterion: &mut Criterion) {
    const REPEAT: usize = 1000;
    type Tile = (Vec<f32>, Vec<f32>, Vec<f32>);
    let (rows, width, zero) = (128, 256, [0.0; 256]);
    let mut group = criterion.benchmark_group("peak");
    group.sample_size(10);
    let tile: Tile = (numbers(rows * width), numbers(width * width), vec![0.0; rows * width]);
    let mut tiles = vec![tile; rayon::current_num_threads()];
    let mut measure = |name: &str, work: &(dyn Fn(&mut Tile) + Sync)| {
        group.bench_function(name, |bencher| {
            bencher
                .iter(|| tiles.par_iter_mut().for_each(|tile| (0..REPEAT).for_each(|_| work(tile))))
        });
    };
    measure("product", &|(x, w, out)| {
        by_gemm([rows, width, width], RowMajor(x), RowMajor(w), out);
    });
    measure("mish", &|(x, _, out)| {
        out.copy_from_slice(x);
        activate(Activation::Mish, out, &zero);
    });
    measure("mish and slope", &|(x, w, out)| {
        out.copy_from_slice(x);
        activate_with_slope(Activation::Mish, out, &zero, &mut w[..rows * width]);
    });
    group.finish();
}

/// The parts of QUAD's update, each by itself.
fn parts(criterion: &mut Criterion) {
    for (name, which, change) in CONFIGURATIONS {
        let Some(("samples", samples)) = change else { continue };
        let mut group = criterion.benchmark_group(name);
        group
            .sample_size(20)
            .measurement_time(Duration::from_secs(2))
            .warm_up_time(Duration::from_millis(500));
        bench_parts(&mut group, &experiment(which, change), samples as usize)
            .expect("candle works");
        group.finish();
    }
}

/// Benchmarks `work` on a thread of the pool, as an update runs.
fn bench<R: Send>(
    group: &mut BenchmarkGroup<'_, WallTime>,
    name: &str,
    mut work: impl FnMut() -> Result<R> + Send,
) {
    group.bench_function(name, |bencher| {
        bencher.iter(|| rayon::scope(|_| work()).expect("candle works"))
    });
}

fn bench_parts(
    group: &mut BenchmarkGroup<'_, WallTime>,
    experiment: &Experiment,
    samples: usize,
) -> Result<()> {
    let count = |name: &str| experiment.agent[name].as_integer().expect("a whole number") as usize;
    let b = experiment.batch_size;
    let (k, steps) = (count("critics"), count("diffusion_steps"));
    let (observation_dim, action_dim) = DIMS;
    let layers = experiment.agent["critic"].clone();
    let layers = layers.try_into().expect("hidden layers");
    let shape = DiffusionShape::quad(DIMS, &layers, k, steps);
    let weights = |layout: Layout| {
        let values = Weights::initial(&layout, &mut ChaCha8Rng::seed_from_u64(0), &Device::Cpu)?;
        Weights::trainable(layout, &values)
    };
    let actor = weights(shape.actor().layout())?;
    let critics = weights(shape.critics().layout())?;
    let (mut actor_adam, mut critic_adam) = (Adam::new(&actor, 0.0)?, Adam::new(&critics, 0.0)?);
    let mut target_actor = NoisePredictor::new(shape.actor(), actor.copy()?, Precision::F32);
    let mut target_critics = Ensemble::new(shape.critics(), critics.copy()?, Precision::F32);
    let mut actor = NoisePredictor::new(shape.actor(), actor, Precision::F32);
    let mut critics = Ensemble::new(shape.critics(), critics, Precision::F32);
    let (observations, actions) = (tensor(&[b, observation_dim]), tensor(&[b, action_dim]));
    let (noise, targets) = (tensor(&[steps, b * samples, action_dim]), tensor(&[b]));

    bench(group, "sampled next actions", || target_actor.sample(&observations, &noise));
    let next = target_actor.sample(&observations, &noise)?;
    bench(group, "target critics", || target_critics.values(&observations, &next));
    let regress = |critics: &Ensemble| {
        let loss = squared_error(&critics.values(&observations, &actions)?, &targets)?;
        Gradients::backward(&loss)?.with_respect_to(critics.weights())
    };
    bench(group, "critic step", || regress(&critics));
    let step = AdamStep::after(0, 1e-9).clipped(1.0);
    let gradient = regress(&critics)?.copy()?;
    critic_adam.set_step(step)?;
    bench(group, "critic optimizer", || critic_adam.apply(critics.weights_mut(), &gradient));
    bench(group, "critic EMA", || target_critics.soft_update(&critics, 0.005));
    bench(group, "Q-gradients' scale", || target_critics.values(&observations, &actions));
    bench(group, "Q-gradients", || target_critics.action_gradients(&observations, &actions));
    let t = Tensor::from_iter((0..b).map(|i| (i % steps + 1) as u32), observations.device())?;
    let clone = |actor: &NoisePredictor| {
        let loss = actor.predict(&observations, &actions, &t)?.sqr()?.mean_all()?;
        Gradients::backward(&loss)?.with_respect_to(actor.weights())
    };
    let threshold = experiment.agent["eta"].get("threshold").is_some();
    bench(group, "actor step", || {
        let gradient = clone(&actor)?;
        // Again for η, with the new weights.
        if threshold {
            actor.detach().predict(&observations, &actions, &t)?;
        }
        Ok(gradient)
    });
    let gradient = clone(&actor)?.copy()?;
    actor_adam.set_step(step)?;
    bench(group, "actor optimizer and EMA", || {
        actor_adam.apply(actor.weights_mut(), &gradient)?;
        target_actor.soft_update(&actor, 0.005)
    });
    Ok(())
}

criterion_group!(benches, peaks, updates, parts);

fn main() {
    // As the learner has it (quad_runtime::choose_threads): candle's own pool and Rayon's would
    // take turns on the cores. SAFETY: there is no other thread yet.
    unsafe { std::env::set_var("CANDLE_NUM_THREADS", "1") };
    benches();
    Criterion::default().configure_from_args().final_summary();
}
