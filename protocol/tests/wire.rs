//! Every message survives the wire; whatever else arrives is a typed error.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod frames;

use std::fmt::Debug;
use std::io::Read;

use frames::{Check, each, snapshot};
use quad_protocol::*;

struct Withstands;

impl Check for Withstands {
    /// What must be true of every message: it survives, and each kind of damage is named.
    fn check<M: Message + PartialEq + Debug>(&mut self, message: &M) {
        let frame = encode(message).unwrap();
        assert_eq!(&decode::<M>(&frame).unwrap(), message);
        let (begin, end) = frame.split_at(frame.len() / 2);
        assert_eq!(
            &decode_from::<M>(frame.len(), begin.chain(end)).unwrap(),
            message,
            "in two pieces"
        );
        assert_eq!(
            decode_from::<M>(frame.len(), begin),
            Err(CodecError::Truncated),
            "without the second piece"
        );

        for length in 0..frame.len() {
            assert_eq!(
                decode::<M>(&frame[..length]),
                Err(CodecError::Truncated),
                "cut to {length} bytes"
            );
        }
        let longer = [&frame[..], &[0; 3]].concat();
        assert_eq!(decode::<M>(&longer), Err(CodecError::Trailing(3)));
        let oversized = [&frame[..], &vec![0; M::LIMIT][..]].concat();
        let (length, limit) = (oversized.len(), M::LIMIT);
        assert_eq!(decode::<M>(&oversized), Err(CodecError::Oversized { length, limit }));
        for bit in 0..8 {
            for byte in 0..4 {
                assert_eq!(decode::<M>(&flipped(&frame, byte, bit)), Err(CodecError::NotQuad));
            }
            for byte in 4..6 {
                let theirs = PROTOCOL_VERSION ^ (1 << (8 * (byte - 4) + bit));
                let expected = Err(CodecError::Version { theirs, ours: PROTOCOL_VERSION });
                assert_eq!(decode::<M>(&flipped(&frame, byte, bit)), expected);
            }
            let found = M::KIND ^ (1 << bit);
            assert_eq!(
                decode::<M>(&flipped(&frame, 6, bit)),
                Err(CodecError::Kind { found, expected: M::KIND })
            );
        }
    }
}

fn flipped(frame: &[u8], byte: usize, bit: usize) -> Vec<u8> {
    let mut frame = frame.to_vec();
    frame[byte] ^= 1 << bit;
    frame
}

#[test]
fn a_message_survives_and_each_kind_of_damage_is_named() {
    each(&mut Withstands);
}

#[test]
fn a_file_that_is_not_the_hash_s() {
    let message = snapshot(vec![7; 100]);
    let frame = encode(&message).unwrap();
    let first = frame.len() - message.file.len();
    for bit in 0..8 * message.file.len() {
        let frame = flipped(&frame, first + bit / 8, bit % 8);
        let found = Hash::of(&frame[first..]);
        assert_eq!(
            decode::<Snapshot>(&frame),
            Err(CodecError::Hash { claimed: message.hash, found })
        );
    }
}

#[test]
fn a_name_that_is_not_allowed_is_malformed() {
    let evaluator = Name::new("a-b").unwrap();
    let message = JobRequest::Claim { evaluator, attempt: 0, environments: vec![] };
    let mut frame = encode(&message).unwrap();
    let dash = frame.iter().position(|&byte| byte == b'-').unwrap();
    frame[dash] = b'/';
    let error = decode::<JobRequest>(&frame).unwrap_err();
    assert_eq!(
        error,
        CodecError::Malformed(
            "a name has only letters, digits, '.', '-' and '_', not '/'".to_owned()
        )
    );
}

#[test]
fn the_largest_file_is_sent_and_what_every_receiver_refuses_is_not() {
    let named_longest =
        |file| Snapshot { run: Name::new("r".repeat(Name::MAX_LENGTH)).unwrap(), ..snapshot(file) };
    let largest = named_longest(vec![1; Snapshot::MOST_FILE]);
    assert!(decode::<Snapshot>(&encode(&largest).unwrap()).unwrap() == largest);
    let error = encode(&named_longest(vec![0; Snapshot::LIMIT])).unwrap_err();
    assert!(matches!(error, CodecError::Oversized { length, limit } if length > limit), "{error}");
}
