//! Tests of checkpoints.

use super::*;

fn checkpoint(step: u64) -> Checkpoint {
    let state = vec![step as u8; 1000];
    Checkpoint { step, state }
}

#[test]
fn keeps_the_newest_and_skips_damaged_ones() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::at(folder.path());
    assert_eq!(run.newest_checkpoint().unwrap(), None);
    for step in [1, 9, 10, 200, 1_000_000_000] {
        run.write_checkpoint(&checkpoint(step)).unwrap();
        assert_eq!(run.newest_checkpoint().unwrap(), Some(checkpoint(step)));
    }
    let files = run.checkpoints().unwrap();
    let steps = Vec::from_iter(files.iter().filter_map(|file| step(file)));
    assert_eq!(steps, [1_000_000_000, 200, 10]);

    // Torn, then a flipped bit, then missing; and a partial file of a crash.
    fs::write(&files[0], &checkpoint(0).state[..500]).unwrap();
    assert_eq!(run.newest_checkpoint().unwrap(), Some(checkpoint(200)));
    let mut bytes = fs::read(&files[1]).unwrap();
    bytes[700] ^= 1;
    fs::write(&files[1], bytes).unwrap();
    let partial = "step_000000300_00.safetensors.partial";
    fs::write(folder.path().join("checkpoints").join(partial), "half").unwrap();
    assert_eq!(run.newest_checkpoint().unwrap(), Some(checkpoint(10)));
    assert_eq!(run.checkpoints().unwrap(), files[2..]);
    fs::remove_file(&files[2]).unwrap();
    assert_eq!(run.newest_checkpoint().unwrap(), None);
}

#[test]
fn an_unreadable_checkpoint_is_an_error_unless_an_older_one_is_good() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::at(folder.path());
    // A folder cannot be read as a file, not even by root.
    let unreadable = folder.path().join("checkpoints/step_000000300_00.safetensors");
    fs::create_dir_all(&unreadable).unwrap();
    let error = run.newest_checkpoint().unwrap_err().to_string();
    assert_eq!(error, format!("cannot read {}", unreadable.display()));
    run.write_checkpoint(&checkpoint(200)).unwrap();
    assert_eq!(run.newest_checkpoint().unwrap(), Some(checkpoint(200)));
    assert!(unreadable.exists());
}
