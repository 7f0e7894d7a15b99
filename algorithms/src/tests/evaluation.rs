//! Tests of evaluations, which measure and change nothing.

use super::*;

/// Hyper-parameters by which an update changes the last digits of nothing.
fn stand_still(table: &mut toml::Table) {
    for (name, value) in table.iter_mut() {
        match value {
            toml::Value::Table(inner) => stand_still(inner),
            _ if name.ends_with("learning_rate") || name.ends_with("ema_rate") => {
                *value = 1e-30.into()
            }
            _ if name == "rate" => *value = 0.0.into(),
            _ => {}
        }
    }
}

/// The losses of networks that are all different, in each phase.
#[test]
fn an_evaluation_measures_the_losses_of_an_update() {
    let mut measured: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for (definition, mut table) in variants() {
        stand_still(&mut table);
        let (mut agent, examples) = start(definition, &table, &context(3, &Device::Cpu));
        for (number, (_, weights)) in
            agent.algorithm.state_dict().networks().into_iter().enumerate()
        {
            weights
                .change(|values| values.slice_set(&(values * (1.0 + 0.1 * number as f64))?, 0, 0))
                .unwrap();
        }
        for step in 0..STEPS {
            let batch = batch(0, &examples);
            let (updated, evaluated) =
                (agent.update(&batch).unwrap(), agent.evaluate(&batch).unwrap());
            for ((metric, updated), evaluated) in
                definition.metrics.iter().zip(updated).zip(evaluated)
            {
                // TD3+BC's policy first moves in its second update, RLPD's not in every one.
                let is_measured = updated.is_some()
                    || matches!((definition.name, step), ("td3-bc", 0) | ("rlpd", _));
                assert_eq!(evaluated.is_some(), metric.held_out && is_measured, "{metric:?}");
                measured.entry(definition.name).or_default().extend(evaluated.map(|_| metric.name));
                let pairs = updated.zip(evaluated);
                assert!(
                    pairs.is_none_or(|(x, y)| (x - y).abs() <= 1e-5 * x.abs().max(1e-3)),
                    "{}, step {step}: {} is {updated:?} in the update, {evaluated:?} in the evaluation",
                    definition.name,
                    metric.name,
                );
            }
        }
    }
    for Definition { name, metrics, .. } in
        ALGORITHMS.iter().filter(|one| measured.contains_key(one.name))
    {
        let held_out = metrics.iter().filter(|metric| metric.held_out).map(|metric| metric.name);
        assert_eq!(measured[*name], held_out.collect(), "{name}");
    }
}

#[test]
fn an_evaluation_changes_nothing() {
    for (definition, table) in variants() {
        let context = context(3, &Device::Cpu);
        let (mut measured, examples) = start(definition, &table, &context);
        let mut alone = agent(definition, &table, &context);
        for step in 0..STEPS {
            let before = measured.save().unwrap();
            let [first, _, again] = [step + 1, step, step + 1]
                .map(|step| measured.evaluate(&batch(step, &examples)).unwrap());
            assert!(first == again && measured.save().unwrap() == before, "{}", definition.name);
            assert_eq!(
                train(&mut measured, &examples, 1),
                train(&mut alone, &examples, 1),
                "{}",
                definition.name
            );
        }
        assert!(measured.save().unwrap() == alone.save().unwrap(), "{}", definition.name);
    }
}
