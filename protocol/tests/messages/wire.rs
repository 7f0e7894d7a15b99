//! Messages survive the wire; damaged ones are typed errors.

use std::fmt::Debug;
use std::io::Read;

use quad_protocol::*;

use crate::frames::{Check, each, snapshot};

struct Survives;

impl Check for Survives {
    fn check<M: Message + PartialEq + Debug>(&mut self, message: &M) {
        let frame = encode(message).unwrap();
        assert_eq!(&decode::<M>(&frame).unwrap(), message);
        let (begin, end) = frame.split_at(frame.len() / 2);
        let in_two_pieces = decode_from::<M>(frame.len(), begin.chain(end));
        assert_eq!(&in_two_pieces.unwrap(), message);
        let without_the_second = decode_from::<M>(frame.len(), begin);
        assert_eq!(without_the_second, Err(CodecError::Truncated));
    }
}

struct NamesDamage;

impl Check for NamesDamage {
    fn check<M: Message + PartialEq + Debug>(&mut self, message: &M) {
        let frame = encode(message).unwrap();
        let damaged = |frame: &[u8], error: CodecError| {
            assert_eq!(decode::<M>(frame), Err(error));
        };
        (0..frame.len()).for_each(|length| damaged(&frame[..length], CodecError::Truncated));
        damaged(&[&frame[..], &[0; 3]].concat(), CodecError::Trailing(3));
        let oversized = [&frame[..], &vec![0; M::LIMIT][..]].concat();
        damaged(&oversized, CodecError::Oversized { length: oversized.len(), limit: M::LIMIT });
        let ours = PROTOCOL_VERSION;
        for bit in 0..8 {
            for byte in 0..4 {
                damaged(&flipped(&frame, byte, bit), CodecError::NotQuad);
            }
            for byte in 4..6 {
                let theirs = ours ^ (1 << (8 * (byte - 4) + bit));
                damaged(&flipped(&frame, byte, bit), CodecError::Version { theirs, ours });
            }
            let (kind, expected) = (M::KIND ^ (1 << bit), M::KIND);
            damaged(&flipped(&frame, 6, bit), CodecError::Kind { kind, expected });
        }
    }
}

fn flipped(frame: &[u8], byte: usize, bit: usize) -> Vec<u8> {
    let mut frame = frame.to_vec();
    frame[byte] ^= 1 << bit;
    frame
}

#[test]
fn messages_survive_and_each_kind_of_damage_is_named() {
    each(&mut Survives);
    each(&mut NamesDamage);
}

#[test]
fn a_file_with_another_hash_is_refused() {
    let message = snapshot(vec![7; 100]);
    let frame = encode(&message).unwrap();
    let first = frame.len() - message.file.len();
    for bit in 0..8 * message.file.len() {
        let frame = flipped(&frame, first + bit / 8, bit % 8);
        let (claimed, actual) = (message.hash, Hash::new(&frame[first..]));
        assert_eq!(decode::<Snapshot>(&frame), Err(CodecError::Hash { claimed, actual }));
    }
}

#[test]
fn an_invalid_name_is_malformed() {
    let evaluator = Name::new("a-b").unwrap();
    let message = JobRequest::Claim { evaluator, attempt: 0, environments: vec![] };
    let mut frame = encode(&message).unwrap();
    let dash = frame.iter().position(|&byte| byte == b'-').unwrap();
    frame[dash] = b'/';
    let problem = "a name has only letters, digits, '.', '-' and '_', not '/'".to_owned();
    assert_eq!(decode::<JobRequest>(&frame), Err(CodecError::Malformed(problem)));
}

#[test]
fn the_largest_file_is_sent_and_a_larger_one_refused() {
    let named_longest =
        |file| Snapshot { run: Name::new("r".repeat(Name::MAX_LENGTH)).unwrap(), ..snapshot(file) };
    let largest = named_longest(vec![1; Snapshot::MOST_FILE]);
    assert!(decode::<Snapshot>(&encode(&largest).unwrap()).unwrap() == largest);
    let error = encode(&named_longest(vec![0; Snapshot::LIMIT])).unwrap_err();
    assert!(matches!(error, CodecError::Oversized { length, limit } if length > limit), "{error}");
}
