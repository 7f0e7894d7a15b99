//! Tests of the file of a policy.

use super::*;
use crate::testing::{initial, load};
use std::fmt::Write;

/// A file of this many tensors without numbers.
fn empty_tensors(count: usize) -> Vec<u8> {
    let mut header = String::from("{\"__metadata__\":{\"quad\":\"none\"}");
    for number in 0..count {
        let tensor = r#"{"dtype":"F32","shape":[0],"data_offsets":[0,0]}"#;
        write!(header, ",\"{number:07}\":{tensor}").unwrap();
    }
    header.push('}');
    [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat()
}

#[test]
fn a_header_that_is_too_long_is_not_read() {
    let is_too_long = |result| match result {
        Err(PolicyError::Unreadable(error)) => matches!(error, SafeTensorError::HeaderTooLarge),
        _ => false,
    };
    let refused =
        |file: &[u8]| [read_tensors(file).map(drop), load(file).map(drop)].map(is_too_long);
    let many = empty_tensors(20_000);
    assert!(many.len() as u64 > MAX_HEADER && SafeTensors::deserialize(&many).is_ok());
    assert_eq!(refused(&many), [true; 2]);
    // Bytes that are not text would be another error.
    let mut noise = vec![0xff; 2 * MAX_HEADER as usize];
    noise[..8].copy_from_slice(&(MAX_HEADER + 1).to_le_bytes());
    assert_eq!(refused(&noise), [true; 2]);

    assert_eq!(read_tensors(&empty_tensors(10_000)).unwrap().len(), 10_000);
    for file in [&empty_tensors(10_000)[..], b"short", b""] {
        assert_eq!(refused(file), [false; 2]);
    }
}

const GAUSSIAN: &str = r#"{"kind":"gaussian","shape":{"observation_dim":3,"action_dim":1,"actor":{"hidden":[4],"activation":"mish","norm":false,"initial":"xavier"}}}"#;

fn gaussian() -> Vec<u8> {
    initial(serde_json::from_str(GAUSSIAN).unwrap())
}

#[test]
fn a_header_is_read_as_written() {
    let file = gaussian();
    assert!((0..30).all(|_| gaussian() == file), "equal bytes");
    let header = Header::<()>::read(&file).unwrap();
    let json = serde_json::to_string(&header.policy).unwrap();
    assert_eq!(json, GAUSSIAN);
    let newer = json.replace("hidden", "width");
    assert!(serde_json::from_str::<PolicyConfig>(&newer).is_err());
    let other_origin = Header::<u64>::read(&file);
    assert!(matches!(other_origin, Err(PolicyError::Header(_))));
    let tensor = Tensor::zeros(1, DType::F32, &Device::Cpu).unwrap();
    let nameless = safetensors::serialize([("weights", tensor)], None).unwrap();
    assert!(matches!(load(&nameless), Err(PolicyError::NoHeader(_))));
}

#[test]
fn a_header_of_another_version_is_read_or_the_error_names_the_version() {
    let replace = |file: &[u8], from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let mut windows = file.windows(from.len());
        let place = windows.position(|bytes| bytes == from.as_bytes()).unwrap();
        [&file[..place], to.as_bytes(), &file[place + from.len()..]].concat()
    };
    let ours = format!(r#"\"version\":\"{VERSION}\""#);
    let theirs = ours.replace(VERSION, &"9".repeat(VERSION.len()));
    let newer = replace(&gaussian(), &ours, &theirs);
    assert!(load(&newer).is_ok());
    let unknown = load(&replace(&newer, "gaussian", "quantile"));
    let error = unknown.err().unwrap().to_string();
    assert!(error.contains("version 99"), "{error}");
    assert!(error.contains("quantile"), "{error}");
}

#[test]
fn a_policy_without_candidates_says_so() {
    let policy = load_policy(&gaussian(), Precision::Bf16).unwrap();
    assert_eq!(policy.precision(), Precision::F32);
    assert_eq!(policy.choice(), None);
    let chosen = policy.with_choice(Choice::best_of(1));
    assert!(matches!(chosen, Err(PolicyError::NoCandidates)));
    let samples = policy.sample(&[0.0; 3], &mut [policy.begin(0)]);
    assert!(matches!(samples, Err(PolicyError::NoCritics)));
    let value = policy.value(&[0.0; 3], &[0.0]);
    assert!(matches!(value, Err(PolicyError::NoCritics)));
}
