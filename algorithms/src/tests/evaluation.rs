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
    for mut variant in variants() {
        stand_still(&mut variant.table);
        let (name, mut trial) = (variant.name, variant.start(&context(3, &Device::Cpu)));
        trial.scale(|number, _| 1.0 + 0.1 * number as f64);
        let batch = trial.batch(0);
        for step in 0..STEPS {
            let updated = trial.agent.update(&batch).unwrap();
            let evaluated = trial.agent.evaluate(&batch).unwrap();
            let metrics = variant.definition.metrics.iter();
            for (metric, (x, y)) in metrics.zip(updated.into_iter().zip(evaluated)) {
                // TD3+BC's policy first moves in its second update, RLPD's not in every one.
                let is_measured =
                    x.is_some() || matches!((name, step), ("td3-bc", 0) | ("rlpd", _));
                assert_eq!(y.is_some(), metric.held_out && is_measured, "{metric:?}");
                let names = measured.entry(name).or_default();
                names.extend(y.map(|_| metric.name));
                let close = |(x, y): (f32, f32)| (x - y).abs() <= 1e-5 * x.abs().max(1e-3);
                let text = || format!("{name}, step {step}: {} is {x:?} and {y:?}", metric.name);
                assert!(x.zip(y).is_none_or(close), "{}", text());
            }
        }
    }
    for (name, measured) in measured {
        let metrics = variant(name).definition.metrics.iter();
        let held_out = metrics.filter(|metric| metric.held_out);
        let held_out = held_out.map(|metric| metric.name).collect();
        assert_eq!(measured, held_out, "{name}");
    }
}

#[test]
fn an_evaluation_changes_nothing() {
    for variant in variants() {
        let [mut measured, mut alone] = [0, 1].map(|_| variant.start(&context(3, &Device::Cpu)));
        for step in 0..STEPS {
            let before = measured.save();
            let [first, _, again] = [step + 1, step, step + 1]
                .map(|step| measured.agent.evaluate(&measured.batch(step)).unwrap());
            let name = variant.name;
            assert!(first == again && measured.save() == before, "{name}");
            assert_eq!(measured.train(1), alone.train(1), "{name}");
        }
        assert!(measured.save() == alone.save(), "{}", variant.name);
    }
}
