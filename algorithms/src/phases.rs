//! Where the phases of a run begin that are so many shares of it.

use super::hyperparameters::Steps;

/// The steps at which phases of these lengths, in proportion, begin in a run of so many steps; the
/// first is 0.
pub(super) fn begin<const N: usize>(total_steps: u64, lengths: [Steps; N]) -> [u64; N] {
    let lengths = lengths.map(|length| u128::from(*length));
    let all: u128 = lengths.iter().sum();
    std::array::from_fn(|phase| {
        (u128::from(total_steps) * lengths[..phase].iter().sum::<u128>() / all) as u64
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_of_any_length_is_divided_as_its_phases_are() {
        let of_onestep = [500_000, 2_000_000, 100_000].map(Steps);
        for (total_steps, expected) in
            [(2_600_000, [0, 500_000, 2_500_000]), (600, [0, 115, 576]), (1, [0, 0, 0])]
        {
            assert_eq!(begin(total_steps, of_onestep), expected);
        }
        assert_eq!(begin(1_050_000, [50_000, 1_000_000].map(Steps)), [0, 50_000]);
    }
}
