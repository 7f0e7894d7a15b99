//! Training phases whose lengths are given in proportion to the run's.

use super::hyperparameters::Steps;

/// The first step of each phase in a run of `total_steps`, for phases of these relative lengths.
pub(super) fn first_steps<const N: usize>(total_steps: u64, lengths: [Steps; N]) -> [u64; N] {
    let lengths = lengths.map(|length| u128::from(*length));
    let all: u128 = lengths.iter().sum();
    std::array::from_fn(|phase| {
        (u128::from(total_steps) * lengths[..phase].iter().sum::<u128>() / all) as u64
    })
}

/// The phase of a step, from 0, and the number of its steps before this one.
pub(super) fn phase(first_steps: &[u64], step: u64) -> (usize, u64) {
    let phase = first_steps.partition_point(|first| *first <= step) - 1;
    (phase, step - first_steps[phase])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phases_divide_a_run_of_any_length_in_proportion() {
        let of_onestep = [500_000, 2_000_000, 100_000].map(Steps);
        for (total_steps, expected) in
            [(2_600_000, [0, 500_000, 2_500_000]), (600, [0, 115, 576]), (1, [0, 0, 0])]
        {
            assert_eq!(first_steps(total_steps, of_onestep), expected);
        }
        assert_eq!([(0, 0), (1, 3), (2, 9)], [0, 118, 585].map(|step| phase(&[0, 115, 576], step)));
    }
}
