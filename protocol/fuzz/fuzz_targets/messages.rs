//! Every decoder, with whatever the fuzzer makes of one message of each kind.
#![no_main]
#![allow(clippy::unwrap_used)]

#[path = "../../tests/messages/frames.rs"]
mod frames;

use std::fs;
use std::path::Path;

use libfuzzer_sys::fuzz_target;
use quad_protocol::keys;

/// Messages for the fuzzer to begin with, where cargo-fuzz lets it look for some.
fn write_seeds() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/messages");
    fs::create_dir_all(&corpus).unwrap();
    for (number, frame) in frames::frames().iter().enumerate() {
        fs::write(corpus.join(format!("seed-{number}")), frame).unwrap();
    }
}

fuzz_target!(init: write_seeds(), |bytes: &[u8]| {
    frames::decode_as_each(bytes);
    // A key is text from the wire, too.
    if let Ok(key) = std::str::from_utf8(bytes) {
        let _ = (keys::run_of(key), keys::incarnation_of(key), keys::step_of(key));
    }
});
