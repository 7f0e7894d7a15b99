//! Rank correlation.

/// Spearman's rank correlation, in which equal numbers share the mean of their ranks; 0 if all of one
/// side are equal.
pub fn rank_correlation(x: &[f64], y: &[f64]) -> f64 {
    let [x, y] = [x, y].map(centered_ranks);
    let dot = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x * y).sum::<f64>();
    let size = (dot(&x, &x) * dot(&y, &y)).sqrt();
    if size == 0.0 { 0.0 } else { dot(&x, &y) / size }
}

/// Ranks, less their mean: half of the count of smaller numbers less that of larger ones.
fn centered_ranks(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let rank = |value: &f64| {
        let smaller = sorted.partition_point(|other| other < value);
        let larger = sorted.len() - sorted.partition_point(|other| other <= value);
        (smaller as f64 - larger as f64) / 2.0
    };
    values.iter().map(rank).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As scipy 1.17.1 (`scipy.stats.spearmanr`) has them.
    #[test]
    fn equal_numbers_share_their_rank() {
        for (x, y, expected) in [
            ([1.0, 2.0, 3.0, 4.0, 5.0], [5.0, 6.0, 7.0, 8.0, 7.0], 0.820_782_681_668_123_4),
            ([0.0, 0.0, 1.0, 2.0, 2.0], [3.0, 1.0, 1.0, -1.0, 0.0], -0.892_217_816_219_194),
            ([0.0, 1.0, 2.0, 3.0, 4.0], [1.0; 5], 0.0),
        ] {
            assert!((rank_correlation(&x, &y) - expected).abs() < 1e-12, "{x:?} {y:?}");
        }
    }
}
