//! Tests of checkpoints.

use super::*;

fn checkpoint(step: u64) -> Checkpoint {
    let state = vec![step as u8; 1000];
    Checkpoint { step, state }
}

#[test]
fn keeps_the_newest_and_skips_damaged_ones() {
    let folder = tempfile::tempdir().unwrap();
    let checkpoints = Checkpoints::of_run(folder.path());
    fs::create_dir(&checkpoints.folder).unwrap();
    assert_eq!(checkpoints.newest().unwrap(), None);
    for step in [1, 9, 10, 200, 1_000_000_000] {
        checkpoints.save(&checkpoint(step)).unwrap();
        assert_eq!(checkpoints.newest().unwrap(), Some(checkpoint(step)));
    }
    let files = checkpoints.files().unwrap();
    let steps = Vec::from_iter(files.iter().filter_map(|file| step(file)));
    assert_eq!(steps, [1_000_000_000, 200, 10]);

    // Torn, then a flipped bit, then missing; and a partial file of a crash.
    fs::write(&files[0], &checkpoint(0).state[..500]).unwrap();
    assert_eq!(checkpoints.newest().unwrap(), Some(checkpoint(200)));
    let mut bytes = fs::read(&files[1]).unwrap();
    bytes[700] ^= 1;
    fs::write(&files[1], bytes).unwrap();
    let partial = "step_000000300_00.safetensors.partial";
    fs::write(checkpoints.folder.join(partial), "half").unwrap();
    assert_eq!(checkpoints.newest().unwrap(), Some(checkpoint(10)));
    assert_eq!(checkpoints.files().unwrap(), files[2..]);
    fs::remove_file(&files[2]).unwrap();
    assert_eq!(checkpoints.newest().unwrap(), None);
}

#[test]
fn an_unreadable_checkpoint_is_an_error_unless_an_older_one_is_good() {
    let folder = tempfile::tempdir().unwrap();
    let checkpoints = Checkpoints::of_run(folder.path());
    fs::create_dir(&checkpoints.folder).unwrap();
    // A folder cannot be read as a file, not even by root.
    let unreadable = checkpoints.folder.join("step_000000300_00.safetensors");
    fs::create_dir_all(&unreadable).unwrap();
    let error = checkpoints.newest().unwrap_err().to_string();
    assert_eq!(error, format!("cannot read {}", unreadable.display()));
    checkpoints.save(&checkpoint(200)).unwrap();
    assert_eq!(checkpoints.newest().unwrap(), Some(checkpoint(200)));
    assert!(unreadable.exists());
}
