//! Tests of `run/lines.rs`.

use super::*;

#[test]
fn a_score_is_read_back_with_every_bit() {
    for number in 1..5_000_u32 {
        let (episode_return, score) =
            (f64::from(number).sqrt() * 37.0, f64::from(number).ln() * 13.7);
        let [weights, precision, evaluator] = [const { String::new() }; 3];
        let line = ScoreLine {
            step: 1,
            seed: 2,
            episode_return,
            length: 3,
            score,
            weights,
            precision,
            evaluator,
        };
        let back: ScoreLine = serde_json::from_str(&serde_json::to_string(&line).unwrap()).unwrap();
        let bits = |line: &ScoreLine| [line.episode_return.to_bits(), line.score.to_bits()];
        assert_eq!(bits(&back), bits(&line), "{episode_return} {score}");
    }
}
