//! Decoders survive mutated messages: each gives an error or a message that encodes as the same
//! bytes, and never panics.
//!
//! `QUAD_MUTATIONS=1000000 cargo test --release -p quad-protocol --test messages mutations` tries
//! as many.

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::Index;

use crate::frames::{decode_as_each, frames};

/// The default takes a second or two.
fn mutations() -> u32 {
    std::env::var("QUAD_MUTATIONS").map_or(200_000, |text| text.parse().expect("a number"))
}

/// A position, the number of bytes removed there, and the bytes inserted: a few, or eight that may be
/// taken for a length.
fn mutation() -> impl Strategy<Value = (Index, usize, Vec<u8>)> {
    const LENGTHS: [u64; 4] = [u64::MAX, 0, 1 << 32, 1 << 20];
    let length = prop_oneof![any::<u64>(), prop::sample::select(&LENGTHS[..]), 0_u64..300];
    let eight = length.prop_map(|length| (8, length.to_le_bytes().to_vec()));
    let few = (0_usize..20, vec(any::<u8>(), 0..20));
    let one = any::<u8>().prop_map(|byte| (1, vec![byte]));
    let change = prop_oneof![eight, few, one];
    (any::<Index>(), change).prop_map(|(position, (removed, bytes))| (position, removed, bytes))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: mutations(), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_decoder_panics(which in any::<Index>(), mutations in vec(mutation(), 1..6)) {
        thread_local!(static FRAMES: Vec<Vec<u8>> = frames());
        let mut frame = FRAMES.with(|frames| which.get(frames).clone());
        for (position, removed, bytes) in mutations {
            let start = position.index(frame.len() + 1);
            drop(frame.splice(start..(start + removed).min(frame.len()), bytes));
        }
        decode_as_each(&frame);
    }
}
