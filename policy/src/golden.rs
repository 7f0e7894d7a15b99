//! Tests: the sampler and acting by the best of several candidates, against an independent
//! implementation (tests/golden/README.md).

#[path = "../../tests/golden/golden.rs"]
mod reader;

use crate::error::PolicyError;
use crate::file::{Header, PolicyConfig, load_policy};
use crate::kinds::diffusion::{DiffusionPolicy, DiffusionShape};
use crate::policy::{Policy, Sampled};
use crate::sampling::choice::{Aggregate, Choice, Rule};
use candle_core::{Device, Tensor};
use quad_kernels::scaling::Scaling;
use quad_nn::{Ensemble, Layout, MlpConfig, NoisePredictor, Precision, Reverse, Tensors, Weights};
use reader::{Golden, goldens};

fn layers(golden: &Golden, pointer: &str) -> MlpConfig {
    serde_json::from_value(golden.config.pointer(pointer).unwrap().clone()).unwrap()
}

fn shape(golden: &Golden) -> DiffusionShape {
    DiffusionShape {
        observation_dim: golden.count("/observation_dim"),
        action_dim: golden.count("/action_dim"),
        actor: layers(golden, "/agent/actor"),
        critic: layers(golden, "/agent/critic"),
        value: None,
        critics: golden.count("/agent/critics"),
        diffusion_steps: golden.count("/agent/diffusion_steps"),
        reverse: Reverse::ClipClean,
    }
}

fn file(shape: DiffusionShape, choice: Choice, tensors: &Tensors) -> Vec<u8> {
    let policy = PolicyConfig::Diffusion { shape, choice };
    Header::new(policy, ()).to_safetensors(tensors).unwrap()
}

#[test]
fn golden_reverse_steps() {
    for golden in goldens("quad") {
        let shape = shape(&golden).actor();
        let weights =
            Weights::take(shape.layout(), &mut golden.state.clone(), "target_actor.").unwrap();
        let actor = NoisePredictor::new(shape.clone(), weights, Precision::F32);
        let observations = golden.input("observations", &Device::Cpu);
        let rows = observations.dim(0).unwrap();
        let step = |t: usize| {
            let x = golden.input("denoise_actions", &Device::Cpu).get(t - 1).unwrap();
            let all = Tensor::full(t as u32, rows, &Device::Cpu).unwrap();
            let epsilon = actor.predict(&observations, &x, &all).unwrap();
            let clean = actor.schedule().clean(t, &x, &epsilon).unwrap();
            (clean, actor.schedule().reverse(t, &x, &epsilon, None).unwrap())
        };
        let (clean, mean): (Vec<_>, Vec<_>) = (1..=shape.diffusion_steps).map(step).unzip();
        golden.close("denoise.x0", &Tensor::stack(&clean, 0).unwrap());
        golden.close("denoise.mean", &Tensor::stack(&mean, 0).unwrap());
    }
}

#[test]
fn golden_choices() {
    for golden in goldens("quad") {
        let (shape, candidates) = (shape(&golden), golden.count("/agent/candidates"));
        let choice = Choice::best_of(candidates as u32);
        let network = |(name, tensor): (&String, &Tensor)| {
            Some((name.strip_prefix("target_")?.to_owned(), tensor.clone()))
        };
        let mut tensors = golden.state.iter().filter_map(network).collect();
        let policy =
            DiffusionPolicy::load(shape.clone(), choice, &mut tensors, Precision::F32).unwrap();
        let numbers = |name: &str| {
            golden.input(name, &Device::Cpu).flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        let (observations, noise) = (numbers("select_observations"), numbers("select_noise"));
        let (drawn, values) = policy.draw(&observations, noise).unwrap();
        let chosen = |values| choice.pick(values, &mut policy.begin(0)).unwrap()[0];
        let chosen: Vec<usize> = values.chunks_exact(candidates).map(chosen).collect();
        let drawn: Vec<&[f32]> = drawn.chunks_exact(policy.action_dim()).collect();
        let taken = chosen.iter().enumerate().map(|(i, chosen)| drawn[i * candidates + chosen]);
        let actions = taken.flatten().copied().collect();
        let tensor = |x: Vec<f32>| Tensor::new(x, &Device::Cpu).unwrap();
        golden.close("select.q", &tensor(values));
        golden.close("select.actions", &tensor(actions));
        let index: Vec<i64> = golden.expected["select.index"].to_vec1().unwrap();
        assert!(
            chosen.iter().zip(&index).all(|(found, expected)| *found as i64 == *expected),
            "{chosen:?} {index:?}"
        );
    }
}

fn small() -> DiffusionShape {
    DiffusionShape::quad((4, 2), &MlpConfig::mish(&[8; 3]), 2, 2)
}

fn policy(choice: Choice, critic: f32, v: Option<f32>) -> Result<Box<dyn Policy>, PolicyError> {
    load_policy(&file_of(choice, critic, v, None), Precision::F32)
}

/// The file of a policy whose critics' weights are so large, of both signs, and whose value
/// function says `v` in every state, if it has one.
pub(crate) fn file_of(
    choice: Choice,
    critic: f32,
    v: Option<f32>,
    scaling: Option<Scaling>,
) -> Vec<u8> {
    let shape = DiffusionShape { value: v.map(|_| small().critic), ..small() };
    let weights = |layout: Layout, size: f32, last: f32| {
        let values = (1..=layout.count()).map(|i| match i / 3 % 2 {
            _ if i == layout.count() => last,
            0 => size,
            _ => -size,
        });
        Weights::constant(layout.clone(), Tensor::from_iter(values, &Device::Cpu).unwrap())
    };
    let actor = NoisePredictor::new(
        shape.actor(),
        weights(shape.actor().layout(), 0.1, 0.1),
        Precision::F32,
    );
    let critics = Ensemble::new(
        shape.critics(),
        weights(shape.critics().layout(), critic, critic),
        Precision::F32,
    );
    let value = shape.value().zip(v);
    let value = value
        .map(|(of, v)| Ensemble::new(of.clone(), weights(of.layout(), 0.0, v), Precision::F32));
    let tensors = DiffusionPolicy::tensors(&actor, &critics, value.as_ref()).unwrap();
    let policy = PolicyConfig::Diffusion { shape, choice };
    Header { scaling, ..Header::new(policy, ()) }.to_safetensors(&tensors).unwrap()
}

/// What it does at the first step of an episode.
fn first_action(policy: &dyn Policy, observation: [f32; 4]) -> Result<Vec<f32>, PolicyError> {
    let mut actions = vec![0.0; 2];
    policy.act(&observation, &mut [policy.begin(3)], &mut actions).map(|()| actions)
}

/// Finite weights so large that values overflow: the error says what is not a number, and nothing
/// is chosen.
#[test]
fn a_candidate_without_a_value_is_an_error() {
    let [good, broken] =
        [0.1, 1e38].map(|critic| policy(Choice::best_of(5), critic, None).unwrap());
    // Of both signs, so that infinities meet.
    let observation = [1.0, -1.0, 1.0, 1.0];
    assert!(first_action(&*good, observation).is_ok());
    let value = first_action(&*broken, observation).unwrap_err().to_string();
    assert!(value.contains("value of a candidate is not a number"), "{value}");
    let of_one = broken.with_choice(Choice::best_of(1)).unwrap();
    assert!(
        first_action(&*of_one, observation).is_ok(),
        "of one candidate the critics are not asked"
    );
    let sampled = of_one.sample(&observation, &mut [of_one.begin(3)]).unwrap_err().to_string();
    assert!(sampled.contains("value of a candidate is not a number"), "{sampled}");
    assert!(of_one.value(&observation, &[0.5, -0.5]).is_err());
    let action = first_action(&*good, [f32::NAN, 0.0, 0.0, 0.0]).unwrap_err().to_string();
    assert!(action.contains("not a number"), "{action}");
}

/// Shapes come from strangers: none may ask for unbounded memory, whatever it wraps around to.
#[test]
fn a_shape_out_of_range_is_refused() {
    let good = small();
    let refused = |shape: DiffusionShape| {
        let file = file(shape, Choice::best_of(1), &Tensors::new());
        matches!(load_policy(&file, Precision::F32), Err(PolicyError::Range { .. }))
    };
    for steps in [0, 1001, (1 << 58) + 1, usize::MAX] {
        assert!(
            refused(DiffusionShape { diffusion_steps: steps, ..good.clone() }),
            "{steps} denoising steps"
        );
    }
    assert!(refused(DiffusionShape { critics: 0, ..good.clone() }));
    assert!(!refused(good), "it lacks its tensors, but its shape is one");
}

#[test]
fn the_file_s_rule_chooses_unless_another_is_asked_for() {
    let best = Choice { value: Aggregate::Min, ..Choice::best_of(8) };
    let nearest = Choice { rule: Rule::Nearest, ..best };
    let act = |policy: &dyn Policy| first_action(policy, [0.5; 4]).unwrap();
    // A value above that of all actions: the nearest is the best. Below: the worst.
    let [high, low] = [1e3, -1e3].map(|v| act(&*policy(nearest, 1.0, Some(v)).unwrap()));
    let policy_of_best = policy(best, 1.0, None).unwrap();
    assert_eq!((policy_of_best.choice(), act(&*policy_of_best)), (Some(best), high.clone()));
    assert_ne!(high, low);
    let cold = Choice { rule: Rule::Softmax { temperature: 1e-6 }, ..best };
    let other = policy_of_best.with_choice(cold).unwrap();
    assert_eq!((other.choice(), act(&*other)), (Some(cold), high.clone()));
    assert!(matches!(policy_of_best.with_choice(nearest), Err(PolicyError::NoValue)));
    assert!(matches!(policy(nearest, 0.1, None), Err(PolicyError::NoValue)));
    assert!(matches!(
        policy_of_best.with_choice(Choice::best_of(10_001)),
        Err(PolicyError::Range { .. })
    ));
    assert_eq!(
        (policy_of_best.choice(), act(&*policy_of_best)),
        (Some(best), high),
        "it stays as it is"
    );
}

/// What is drawn in some states: `act` takes of each state's candidates the one of the largest
/// value, which `value` gives, too.
#[test]
fn what_is_sampled_is_what_is_chosen_among() {
    for value in [Aggregate::Mean, Aggregate::Min] {
        let policy = policy(Choice { value, ..Choice::best_of(6) }, 1.0, None).unwrap();
        let observations: Vec<f32> = (0..12).map(|i| (i as f32).sin()).collect();
        let begin = || [7, 8, 9].map(|seed| policy.begin(seed));
        let Sampled { actions, values } = policy.sample(&observations, &mut begin()).unwrap();
        assert_eq!((actions.len(), values.len()), (3 * 6 * 2, 3 * 6));
        let mut taken = vec![0.0; 6];
        policy.act(&observations, &mut begin(), &mut taken).unwrap();
        for (i, taken) in taken.chunks_exact(2).enumerate() {
            let (actions, values) = (&actions[i * 12..][..12], &values[i * 6..][..6]);
            let largest = (1..6).fold(0, |best, j| if values[j] > values[best] { j } else { best });
            assert_eq!(taken, &actions[largest * 2..][..2], "state {i}");
            assert!(values.iter().any(|value| value != &values[0]), "there is something to choose");
            let observations = observations[i * 4..][..4].repeat(6);
            assert_eq!(policy.value(&observations, actions).unwrap(), values, "state {i}");
        }
        let alone = policy.sample(&observations[4..8], &mut [policy.begin(8)]).unwrap();
        assert_eq!(
            (&alone.actions[..], &alone.values[..]),
            (&actions[12..24], &values[6..12]),
            "of its own seed alone"
        );
        assert!(policy.value(&observations, &actions).is_err(), "3 observations, 18 actions");
    }
}
