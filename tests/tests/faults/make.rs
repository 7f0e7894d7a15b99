//! Files that `learner datasets make` makes are the same for any number of evaluators and after a
//! kill.

use std::collections::BTreeMap;
use std::fs;

use quad_tests::process::{Process, command};
use quad_tests::wait_until;

const MAKE: &str = "learner datasets make hopper --seed 3 --scale 0.001 --evaluators";

#[test]
fn files_are_the_same_for_any_number_of_evaluators_and_after_a_kill() {
    let folder = tempfile::tempdir().unwrap();
    let start = |name: &str, evaluators: u32| {
        let mut command = command(&format!("{MAKE} {evaluators}"));
        command.env("QUAD_DATASETS_DIR", folder.path().join(name));
        Process::start(name, folder.path(), command)
    };
    let [mut calm, mut killed] = [start("calm", 1), start("killed", 8)];
    let log = folder.path().join("killed/hopper-sac-scale0.001-seed3/experience.log");
    wait_until("experience comes", || {
        log.metadata().is_ok_and(|log| log.len() > 90_000) || !killed.is_running()
    });
    killed.kill();
    killed = start("killed", 8);
    for making in [&mut calm, &mut killed] {
        making.assert_ends(0);
        making.assert_said("hopper-medium-scale0.001-seed3");
    }
    let files = |name: &str| {
        let entries = fs::read_dir(folder.path().join(name)).unwrap();
        let paths = entries.map(|entry| entry.unwrap().path()).filter(|path| path.is_file());
        let bytes =
            paths.map(|path| (path.file_name().unwrap().to_owned(), fs::read(path).unwrap()));
        BTreeMap::from_iter(bytes)
    };
    let made = files("calm");
    assert!(made.len() == 3 && made == files("killed"));
}
