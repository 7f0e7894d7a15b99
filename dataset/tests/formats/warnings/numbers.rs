use quad_dataset::{Normalize, ReadOptions, Transitions, inspect};
use tempfile::tempdir;

use super::{Cart, O};

#[test]
fn rewards_that_are_all_alike() {
    let mut cart = Cart::new(false);
    cart.rewards.fill(1.0);
    let expected = "array `rewards`: all are alike (1), so nothing distinguishes good from bad but how soon an episode terminates";
    assert_eq!(cart.warnings(true), [expected]);
    cart.rewards.fill(0.0);
    assert_eq!(
        cart.warnings(false),
        ["array `rewards`: all are alike (0), so nothing distinguishes good from bad"]
    );
    cart.rewards[70] = 1e-1;
    assert_eq!(cart.warnings(false), [""; 0]);
    cart.rewards
        .iter_mut()
        .enumerate()
        .for_each(|(row, reward)| *reward = (0.1 + 1e-9 * row as f64) as f32);
    assert!(cart.warning(false).starts_with("array `rewards`: all are alike (0.1)"));
    cart.rewards
        .iter_mut()
        .enumerate()
        .for_each(|(row, reward)| *reward = (0.1 + 1e-7 * row as f64) as f32);
    assert_eq!(cart.warnings(false), [""; 0]);
}

#[test]
fn observations_too_large_or_too_small_to_train_on_as_they_are() {
    let mut cart = Cart::new(false);
    cart.observe(|row| {
        (row[1], row[2], row[3]) = (1e6 + 1e3 * row[1], 50.0 + 1e-4 * row[2], 90.0 * row[3])
    });
    let warnings = cart.warnings(true);
    let [large, small] = &warnings[..] else { panic!("{warnings:?}") };
    assert!(
        large.starts_with("array `observations`: far from ±1 in column 1, of size 999980, which"),
        "{large}"
    );
    assert!(
        small.starts_with(
            "array `observations`: hardly changes in column 2, by a standard deviation of"
        ),
        "{small}"
    );
    assert!(
        large.contains("--normalize observations") && small.contains("--normalize observations"),
        "{warnings:?}"
    );
    assert_eq!(scaled(&cart, Normalize { observations: true, ..Normalize::default() }), [""; 0]);
    cart.observe(|row| (row[1], row[2]) = (1e-6 * (row[1] - 1e6), 0.0));
    assert!(cart.warning(true).starts_with("array `observations`: hardly changes in column 1"));
    cart.observe(|row| row[1] *= 1e4);
    assert_eq!(cart.warnings(true), [""; 0]);
}

#[test]
fn actions_too_small_to_learn() {
    let mut cart = Cart::new(false);
    cart.actions.chunks_exact_mut(2).for_each(|action| action[1] *= 1e-4);
    let warning = cart.warning(true);
    assert!(
        warning.starts_with("array `actions`: hardly changes in column 1")
            && warning.contains("--normalize actions")
    );
    assert_eq!(scaled(&cart, Normalize { actions: true, ..Normalize::default() }), [""; 0]);
}

#[test]
fn rewards_of_a_size_that_methods_are_not_made_for() {
    let mut cart = Cart::new(false);
    let scale = |cart: &mut Cart, by: f32| cart.rewards.iter_mut().for_each(|reward| *reward *= by);
    scale(&mut cart, 400.0);
    let warning = cart.warning(true);
    assert!(
        warning.starts_with("array `rewards`: of size") && warning.contains("episodes return -"),
        "{warning}"
    );
    assert!(warning.contains("`learner train --normalize rewards`"), "{warning}");
    assert_eq!(scaled(&cart, Normalize { rewards: true, ..Normalize::default() }), [""; 0]);
    scale(&mut cart, 1e-6);
    assert!(cart.warning(false).contains("1 for good and bad actions alike"));
    // Rare rewards of ordinary size are not small.
    cart.rewards.fill(0.0);
    cart.rewards[100] = 1.0;
    assert_eq!(cart.warnings(false), [""; 0]);
}

fn scaled(cart: &Cart, normalize: Normalize) -> Vec<String> {
    let folder = tempdir().unwrap();
    let path = folder.path().join("cart.hdf5");
    cart.write(&path, true);
    let options = ReadOptions { normalize, ..ReadOptions::default() };
    Transitions::read(&path, &options).unwrap().warnings().to_vec()
}

#[test]
fn numbers_that_never_change_are_named() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("cart.hdf5");
    let mut cart = Cart::new(false);
    cart.observe(|row| (row[1], row[3]) = (0.1, 90.0));
    cart.actions.chunks_exact_mut(2).for_each(|action| action[1] = 0.3);
    assert_eq!(cart.warnings(true), [""; 0]);
    cart.write(&path, true);
    let inspection = inspect(&path, None).unwrap();
    assert_eq!(
        (&inspection.constant_observations[..], &inspection.constant_actions[..]),
        (&[1, 3][..], &[1][..])
    );
    let page = inspection.to_string();
    assert!(page.contains("observations  4 numbers; constant: columns 1, 3\n"), "{page}");
    assert!(page.contains("actions       2 numbers; constant: column 1\n"), "{page}");
    assert!(page.contains("rewards       of size 0."), "{page}");
}

#[test]
fn an_array_that_was_rounded_is_in_step_with_the_other() {
    let cart = Cart::new(false);
    let half = |x: &f32| f32::from_bits((x.to_bits() + 0x1000) & !0x1fff);
    for own in [false, true] {
        let rounded = Cart {
            next_observations: cart.next_observations.iter().map(half).collect(),
            ..Cart::new(false)
        };
        let folder = tempdir().unwrap();
        let path = folder.path().join("cart.hdf5");
        rounded.write(&path, own);
        if !own {
            let file = hdf5::File::open_rw(&path).unwrap();
            crate::put(
                &file,
                "next_observations",
                &[cart.rewards.len(), O],
                &rounded.next_observations,
            );
        }
        assert_eq!(inspect(&path, None).unwrap().problems, [""; 0]);
        let other =
            Cart { observations: cart.observations.iter().map(half).collect(), ..Cart::new(false) };
        assert_eq!(other.warnings(own), [""; 0]);
    }
}
