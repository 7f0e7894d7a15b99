//! Every message survives the wire; whatever else arrives is a typed error.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fmt::Debug;
use std::io::Read;
use std::time::Duration;

use proptest::collection::vec;
use proptest::prelude::*;
use quad_protocol::*;

fn name() -> impl Strategy<Value = Name> {
    // Without proptest's regular expressions, which are a large dependency.
    let alphabet: Vec<char> = ('a'..='z').chain('A'..='Z').chain('0'..='9').chain(['.', '-', '_']).collect();
    vec(proptest::sample::select(alphabet), 1..=Name::MAX_LENGTH)
        .prop_filter_map("a folder", |characters| Name::new(String::from_iter(characters)).ok())
}

fn text() -> impl Strategy<Value = String> {
    vec(any::<char>(), 0..20).prop_map(String::from_iter)
}

fn hash() -> impl Strategy<Value = Hash> {
    any::<[u8; 8]>().prop_map(|bytes| Hash::of(&bytes))
}

/// Any number, also infinite ones; NaN is unequal to itself.
fn number() -> impl Strategy<Value = f64> {
    any::<f64>().prop_filter("NaN", |number| !number.is_nan())
}

fn episodes() -> impl Strategy<Value = Vec<EpisodeScore>> {
    let episode = (any::<u64>(), number(), any::<u32>(), number());
    vec(
        episode.prop_map(|(seed, episode_return, length, score)| EpisodeScore { seed, episode_return, length, score }),
        0..20,
    )
}

fn snapshot() -> impl Strategy<Value = Snapshot> {
    (name(), any::<u64>(), any::<u64>(), vec(any::<u8>(), 0..500)).prop_map(|(run, incarnation, step, file)| Snapshot {
        run,
        incarnation,
        step,
        hash: Hash::of(&file),
        file,
    })
}

fn job_request() -> impl Strategy<Value = JobRequest> {
    let claim = (name(), any::<u64>(), vec(text(), 0..5))
        .prop_map(|(evaluator, attempt, environments)| JobRequest::Claim { evaluator, attempt, environments });
    let hand_back = (name(), any::<u64>(), prop::option::of(text()))
        .prop_map(|(evaluator, job, failed)| JobRequest::HandBack { evaluator, job, failed });
    prop_oneof![claim, hand_back]
}

fn job_reply() -> impl Strategy<Value = JobReply> {
    let job = (any::<[u64; 5]>(), name(), hash(), text(), vec(any::<u64>(), 0..100)).prop_map(
        |([id, incarnation, step, environment_seed, progress_milliseconds], run, weights, environment, seeds)| {
            JobReply::Job(Job {
                id,
                run,
                incarnation,
                step,
                weights,
                environment,
                environment_seed,
                seeds,
                progress_milliseconds,
            })
        },
    );
    let wait = any::<[u64; 2]>().prop_map(|[incarnation, milliseconds]| JobReply::Wait { incarnation, milliseconds });
    let handed_back = (any::<u64>(), any::<bool>())
        .prop_map(|(incarnation, accepted)| JobReply::HandedBack { incarnation, accepted });
    prop_oneof![job, wait, handed_back]
}

fn score_report() -> impl Strategy<Value = ScoreReport> {
    (name(), name(), any::<[u64; 3]>(), hash(), name(), episodes()).prop_map(
        |(evaluator, run, [incarnation, job, step], weights, precision, episodes)| ScoreReport {
            evaluator,
            run,
            incarnation,
            job,
            step,
            weights,
            precision,
            episodes,
        },
    )
}

fn score_reply() -> impl Strategy<Value = ScoreReply> {
    let recorded = (any::<u64>(), any::<[u32; 2]>())
        .prop_map(|(incarnation, [new, duplicates])| ScoreReply::Recorded { incarnation, new, duplicates });
    let refused = (any::<u64>(), text()).prop_map(|(incarnation, reason)| ScoreReply::Refused { incarnation, reason });
    prop_oneof![recorded, refused]
}

fn progress() -> impl Strategy<Value = Progress> {
    (name(), name(), any::<[u64; 6]>(), any::<[u32; 2]>()).prop_map(
        |(evaluator, run, numbers, [episodes_done, episodes_total])| {
            let [incarnation, job, step, steps_done, environment_steps, episodes] = numbers;
            Progress {
                evaluator,
                run,
                incarnation,
                job,
                step,
                episodes_done,
                episodes_total,
                steps_done,
                environment_steps,
                episodes,
            }
        },
    )
}

/// What must be true of every message: it survives, and each kind of damage is named.
fn withstands_the_wire<M: Message + PartialEq + Debug>(message: &M) -> Result<(), TestCaseError> {
    let frame = encode(message).unwrap();
    prop_assert_eq!(&decode::<M>(&frame).unwrap(), message);
    let (begin, end) = frame.split_at(frame.len() / 2);
    prop_assert_eq!(&decode_from::<M>(frame.len(), begin.chain(end)).unwrap(), message, "in two pieces");
    prop_assert_eq!(decode_from::<M>(frame.len(), begin), Err(CodecError::Truncated), "without the second piece");

    for length in 0..frame.len() {
        prop_assert_eq!(decode::<M>(&frame[..length]), Err(CodecError::Truncated), "cut to {} bytes", length);
    }
    let longer = [&frame[..], &[0; 3]].concat();
    prop_assert_eq!(decode::<M>(&longer), Err(CodecError::Trailing(3)));
    let oversized = [&frame[..], &vec![0; M::LIMIT][..]].concat();
    let (length, limit) = (oversized.len(), M::LIMIT);
    prop_assert_eq!(decode::<M>(&oversized), Err(CodecError::Oversized { length, limit }));
    for bit in 0..8 {
        for byte in 0..4 {
            prop_assert_eq!(decode::<M>(&flipped(&frame, byte, bit)), Err(CodecError::NotQuad));
        }
        for byte in 4..6 {
            let theirs = PROTOCOL_VERSION ^ (1 << (8 * (byte - 4) + bit));
            let expected = Err(CodecError::Version { theirs, ours: PROTOCOL_VERSION });
            prop_assert_eq!(decode::<M>(&flipped(&frame, byte, bit)), expected);
        }
        let found = M::KIND ^ (1 << bit);
        prop_assert_eq!(decode::<M>(&flipped(&frame, 6, bit)), Err(CodecError::Kind { found, expected: M::KIND }));
    }
    Ok(())
}

fn flipped(frame: &[u8], byte: usize, bit: usize) -> Vec<u8> {
    let mut frame = frame.to_vec();
    frame[byte] ^= 1 << bit;
    frame
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn job_requests(message in job_request()) { withstands_the_wire(&message)?; }

    #[test]
    fn job_replies(message in job_reply()) { withstands_the_wire(&message)?; }

    #[test]
    fn score_reports(message in score_report()) { withstands_the_wire(&message)?; }

    #[test]
    fn score_replies(message in score_reply()) { withstands_the_wire(&message)?; }

    #[test]
    fn progress_messages(message in progress()) { withstands_the_wire(&message)?; }

    #[test]
    fn random_bytes_are_no_message(bytes in vec(any::<u8>(), 0..300)) {
        prop_assert!(matches!(decode::<Progress>(&bytes), Err(CodecError::NotQuad | CodecError::Truncated)));
    }

    #[test]
    fn random_fields_are_a_message_or_an_error(body in vec(any::<u8>(), 0..300)) {
        fn check<M: Message + Debug>(body: &[u8]) {
            let header = [&b"QUAD"[..], &PROTOCOL_VERSION.to_le_bytes(), &[M::KIND]].concat();
            if let Ok(message) = decode::<M>(&[&header[..], body].concat()) {
                assert_eq!(encode(&message).unwrap()[header.len()..], *body, "{message:?}");
            }
        }
        check::<Snapshot>(&body);
        check::<JobRequest>(&body);
        check::<JobReply>(&body);
        check::<ScoreReport>(&body);
        check::<ScoreReply>(&body);
        check::<Progress>(&body);
    }
}

proptest! {
    // An oversized snapshot is 64 MiB; a few are enough.
    #![proptest_config(ProptestConfig { cases: 8, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn snapshots(message in snapshot()) { withstands_the_wire(&message)?; }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_file_that_is_not_the_hash_s(message in snapshot(), bit in any::<prop::sample::Index>()) {
        prop_assume!(!message.file.is_empty());
        let mut frame = encode(&message).unwrap();
        let bit = bit.index(8 * message.file.len());
        let first = frame.len() - message.file.len();
        frame[first + bit / 8] ^= 1 << (bit % 8);
        let found = Hash::of(&frame[first..]);
        prop_assert_eq!(decode::<Snapshot>(&frame), Err(CodecError::Hash { claimed: message.hash, found }));
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
    assert_eq!(error, CodecError::Malformed("a name has only letters, digits, '.', '-' and '_', not '/'".to_owned()));
    assert_eq!(error.label(), "malformed");
}

fn message(file: Vec<u8>) -> Snapshot {
    let run = Name::new("r".repeat(Name::MAX_LENGTH)).unwrap();
    Snapshot { run, incarnation: 1, step: 1, hash: Hash::of(&file), file }
}

#[test]
fn the_largest_file_is_sent_and_what_every_receiver_refuses_is_not() {
    let largest = message(vec![1; Snapshot::MOST_FILE]);
    assert!(decode::<Snapshot>(&encode(&largest).unwrap()).unwrap() == largest);
    let error = encode(&message(vec![0; Snapshot::LIMIT])).unwrap_err();
    assert!(matches!(error, CodecError::Oversized { length, limit } if length > limit), "{error}");
}

#[test]
fn six_megabytes_take_milliseconds() {
    let message = message((0..6_000_000u32).map(|i| i.wrapping_mul(2_654_435_761).to_le_bytes()[3]).collect());
    // This thread's time on a processor, whatever others do there.
    let spent = || {
        std::thread::yield_now();
        let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
        Duration::from_nanos(text.split(' ').next().unwrap().parse().unwrap())
    };
    let fastest = |work: &dyn Fn()| {
        let times = (0..10).map(|_| {
            let begin = spent();
            work();
            spent() - begin
        });
        times.min().unwrap()
    };
    let frame = encode(&message).unwrap();
    let encoding = fastest(&|| drop(encode(&message).unwrap()));
    let decoding = fastest(&|| drop(decode::<Snapshot>(&frame).unwrap()));
    assert!(encoding < Duration::from_millis(20), "{encoding:?}");
    assert!(decoding < Duration::from_millis(60), "{decoding:?}");
}
