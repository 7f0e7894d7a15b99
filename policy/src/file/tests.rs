//! Tests of `kind.rs`.

use super::*;
use quad_nn::MlpConfig;
use std::fmt::Write;

/// A file of so many tensors without numbers.
fn empty_tensors(count: usize) -> Vec<u8> {
    let mut header = String::from("{\"__metadata__\":{\"quad\":\"none\"}");
    for number in 0..count {
        write!(
            header,
            ",\"{number:07}\":{{\"dtype\":\"F32\",\"shape\":[0],\"data_offsets\":[0,0]}}"
        )
        .unwrap();
    }
    header.push('}');
    [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat()
}

#[test]
fn a_header_that_is_too_long_is_not_even_read() {
    let refused = |file: &[u8]| {
        let [read, loaded] =
            [read_tensors(file).map(drop), load_policy(file, Precision::F32).map(drop)];
        [read, loaded].map(|result| {
            matches!(result, Err(PolicyError::Unreadable(SafeTensorError::HeaderTooLarge)))
        })
    };
    let many = empty_tensors(20_000);
    assert!(many.len() as u64 > MAX_HEADER && SafeTensors::deserialize(&many).is_ok());
    assert_eq!(refused(&many), [true; 2]);
    // Reading it would find that this is no text.
    let noise =
        [&(MAX_HEADER + 1).to_le_bytes()[..], &vec![0xff; 2 * MAX_HEADER as usize]].concat();
    assert_eq!(refused(&noise), [true; 2]);

    assert_eq!(read_tensors(&empty_tensors(10_000)).unwrap().len(), 10_000);
    for file in [&empty_tensors(10_000)[..], b"short", b""] {
        assert_eq!(refused(file), [false; 2]);
    }
}

/// The file of a Gaussian policy that is from `origin`.
fn gaussian(origin: &str) -> Vec<u8> {
    let actor = MlpConfig::mish(&[4]);
    let shape = GaussianShape { observation_dim: 3, action_dim: 1, actor };
    let policy = PolicyConfig::Gaussian { shape };
    let tensors =
        policy.tensors(|layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu)).unwrap();
    Header::new(policy, origin).to_safetensors(&tensors).unwrap()
}

#[test]
fn a_file_says_what_it_is_and_where_it_is_from() {
    let file = gaussian("\"a run\"");
    assert!((0..30).all(|_| gaussian("\"a run\"") == file), "the same file has the same bytes");
    let header = Header::<String>::read(&file).unwrap();
    assert_eq!(header.origin, "\"a run\"");
    let json = serde_json::to_string(&header.policy).unwrap();
    let actor = r#"{"hidden":[4],"activation":"mish","norm":false,"initial":"xavier"}"#;
    let shape = format!(r#"{{"observation_dim":3,"action_dim":1,"actor":{actor}}}"#);
    assert_eq!(json, format!(r#"{{"kind":"gaussian","shape":{shape}}}"#));
    let newer = json.replace("hidden", "width");
    assert!(
        serde_json::from_str::<PolicyConfig>(&newer).is_err(),
        "what is not known is not ignored"
    );
    let tensor = Tensor::zeros(1, DType::F32, &Device::Cpu).unwrap();
    let nameless = safetensors::serialize([("weights", tensor)], None).unwrap();
    assert!(matches!(load_policy(&nameless, Precision::F32), Err(PolicyError::NoHeader(_))));
    assert!(
        matches!(Header::<u64>::read(&file), Err(PolicyError::Header(_))),
        "another origin than was wanted"
    );
}

#[test]
fn what_another_version_wrote_is_read_or_it_says_which_version_reads_it() {
    let text = |file: &[u8], from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let at = file.windows(from.len()).position(|window| window == from.as_bytes()).unwrap();
        [&file[..at], to.as_bytes(), &file[at + from.len()..]].concat()
    };
    let (file, ours) = (gaussian(""), format!(r#"\"version\":\"{VERSION}\""#));
    let theirs = ours.replace(VERSION, &"9".repeat(VERSION.len()));
    let newer = text(&file, &ours, &theirs);
    assert!(load_policy(&newer, Precision::F32).is_ok(), "it says nothing that is not known here");
    let error = load_policy(&text(&newer, "gaussian", "quantile"), Precision::F32)
        .err()
        .unwrap()
        .to_string();
    assert!(error.contains("version 99") && error.contains("quantile"), "{error}");
}

#[test]
fn a_policy_says_the_precision_that_it_has() {
    let policy = load_policy(&gaussian(""), Precision::Bf16).unwrap();
    assert_eq!((policy.precision(), policy.choice()), (Precision::F32, None));
    assert!(matches!(policy.with_choice(Choice::best_of(1)), Err(PolicyError::NoCandidates)));
    assert!(matches!(
        policy.sample(&[0.0; 3], &mut [policy.begin(0)]),
        Err(PolicyError::NoCritics)
    ));
    assert!(matches!(policy.value(&[0.0; 3], &[0.0]), Err(PolicyError::NoCritics)));
}
