//! Tests of states, data and hyper-parameters that are refused.

use super::*;

/// A place of guidance, but no guidance.
const UNGUIDED: &str = "guidance = 'none'\nguidance_at = 'denoised'";

#[test]
fn contradictory_hyper_parameters_are_refused() {
    for (name, change, words) in [
        ("sfbc", "averaged = 7", "at most agent.candidates"),
        ("sfbc", "actor.norm = true", "actor.norm"),
        ("diffuser", "replan_every = 1000", "agent.network.horizon"),
        ("diffuser", "network.groups = 0", "agent.network.groups is 0"),
        ("quad", "eta.maximum = -1.0", "at least 0"),
        ("quad", "eta.initial = 1e9", "eta.minimum and eta.maximum"),
        ("quad", UNGUIDED, "is denoised, but must be absent"),
        ("quad", "chunk = 0", "a whole number from 1"),
        ("idql", "chunk = 3\nreplan = 4", "agent.replan is 4"),
        ("fql", "replan = 2", "at most agent.chunk"),
        ("xql", "random_actions = 300", "from 0 to 255"),
        ("iql", "chunk = 2", "iql learns single actions"),
        ("iql", "history = 2", "agent.history must be 1"),
    ] {
        let mut variant = variant(name);
        merge(&mut variant.table, change.parse().unwrap());
        let error = variant.definition.check(&variant.table).unwrap_err();
        let error = error.to_string();
        assert!(error.contains(words), "{name}: {error}");
    }
}

#[test]
fn an_error_names_the_hyper_parameter() {
    for definition in ALGORITHMS {
        let mut values = Values::read(definition).for_task(None);
        let agent = values.remove("agent").unwrap().as_table().unwrap().clone();
        for key in agent.keys().filter(|key| agent[*key].is_float()) {
            for (value, words) in
                [(Some("much"), format!("in `{key}`")), (None, format!("missing field `{key}`"))]
            {
                let mut table = agent.clone();
                table.remove(key);
                table.extend(value.map(|value| (key.clone(), value.into())));
                let error = definition.check(&table).unwrap_err().to_string();
                assert!(error.contains(&words), "{} {key}: {error}", definition.name);
            }
        }
    }
}

#[test]
fn data_without_examples_is_refused_with_a_hint() {
    let mut single = arrays();
    (single.terminals, single.timeouts) = (vec![false; 10 * BATCH], vec![true; 10 * BATCH]);
    let single = Arc::new(Transitions::of(single).unwrap());
    for (name, words, hint) in [
        ("onestep", "has a next action", "datasets inspect"),
        ("rebrac", "has a next action", "datasets inspect"),
        ("sfbc", "transitions (agent.shortest_episode)", "shortest_episode=1"),
        ("diffuser", "plans ahead", "network.horizon=8"),
    ] {
        let mut variant = variant(name);
        if name == "sfbc" {
            variant.table["shortest_episode"] = 2.into();
        }
        let trial = variant.start(&context(0, &Device::Cpu));
        let error = trial.agent.examples(single.clone()).err().unwrap();
        assert!(error.to_string().contains(words), "{error}");
        assert!(error.hint().contains(hint), "{error}");
    }
}

#[test]
fn an_unfit_state_is_refused() {
    let (iql, mut wider) = (variant("iql"), variant("iql"));
    wider.table["actor"]["hidden"] = vec![25].into();
    let context = context(3, &Device::Cpu);
    let mut trial = iql.start(&context);
    let (saved, policy) = (trial.save(), trial.policy());
    for (variant, bytes, words) in [
        (variant("quad"), &saved[..], "is of the algorithm iql, this run is of quad"),
        (wider, &saved, "shape"),
        (variant("iql"), b"", ""),
        (variant("iql"), b"nonsense", ""),
        (variant("iql"), &saved[..saved.len() - 1], ""),
        (variant("iql"), &policy, "`state`"),
    ] {
        let error = variant.start(&context).agent.load(bytes).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
    }
}
