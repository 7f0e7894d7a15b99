//! Command lines and what they print: the transcripts beside this file. `TRYCMD=overwrite cargo
//! test …` writes anew what is printed.

use std::env;
use std::fs::{self, Permissions};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use quad_tests::PATIENCE;
use quad_tests::certificates::Certificates;
use quad_tests::process::{binary, built, succeeds};
use quad_tests::setting::SHORT;
use quad_tests::system::Scratch;

use crate::own_data::{train, write_log};

#[test]
fn commands_print_what_their_transcripts_have() {
    let scratch = Scratch::new();
    env::set_current_dir(scratch.path()).unwrap();
    write_files(&scratch);
    write_run(&scratch);
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let programs = binary("learner").parent().unwrap().display().to_string();
    let cases = trycmd::TestCases::new();
    cases
        .register_bins(["learner", "evaluator"].map(|name| (name, binary(name))))
        .register_bin("sh", Path::new("/bin/sh"))
        .env("PATH", format!("{programs}:{}", env::var("PATH").unwrap()))
        .env("LC_ALL", "C")
        .env("HOME", scratch.path().to_str().unwrap())
        .env("NO_LOCKS", built("examples/libno_locks.so").to_str().unwrap())
        .env("TAKEN", taken.local_addr().unwrap().to_string())
        // Nothing but this machine can be reached: the proxy for everything else is a closed port.
        .env("ALL_PROXY", "http://127.0.0.1:9")
        .env("NO_PROXY", "127.0.0.1")
        .env("QUAD_DATASETS_URL", "http://127.0.0.1:9")
        .env("D4RL_DATASET_DIR", "cache");
    let transcripts = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/programs"));
    for name in ["usage", "data", "datasets", "doctor", "policies", "judge"] {
        cases.case(transcripts.join(format!("{name}.trycmd")));
    }
    if let [Some(ours), Some(others)] = [(); 2].map(|()| Certificates::make()) {
        fs::rename(ours.folder(), "certificates").unwrap();
        fs::rename(others.folder(), "elsewhere").unwrap();
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/zenoh/certificates.sh");
        cases.register_bin("certificates.sh", Path::new(script));
        cases.case(transcripts.join("certificates.trycmd"));
    }
    cases.run();
}

/// Files that are no datasets, an evaluator that cannot start, and a cache of datasets.
fn write_files(scratch: &Scratch) {
    scratch.preset("tiny", SHORT);
    let whole = fs::read("tiny.hdf5").unwrap();
    fs::write("half.hdf5", &whole[..whole.len() / 2]).unwrap();
    fs::write("notes.hdf5", "my notes").unwrap();
    fs::copy("tiny.hdf5", "without-infos.hdf5").unwrap();
    hdf5::File::open_rw("without-infos.hdf5").unwrap().unlink("infos").unwrap();
    succeeds("evaluator collect --env walker2d --transitions 500 --out walker.hdf5");
    fs::create_dir_all("broken").unwrap();
    fs::copy(binary("learner"), "broken/learner").unwrap();
    let script = "#!/bin/sh\necho libmujoco.so: cannot open shared object file >&2; exit 127\n";
    fs::write("broken/evaluator", script).unwrap();
    fs::set_permissions("broken/evaluator", Permissions::from_mode(0o755)).unwrap();
    fs::create_dir("cache").unwrap();
    fs::write("cache/hopper_random-v2.hdf5", "").unwrap();
    fs::write("cache/hopper_medium-v2.hdf5", "half of it").unwrap();
    fs::create_dir("other").unwrap();
    fs::write("other/config.toml", "name = 'x'\nlist = [\n").unwrap();
}

/// A run without evaluations, snapshots that are not what they should be, and two runs on a log.
fn write_run(scratch: &Scratch) {
    let mut learner = scratch.learner_with("run", SHORT, &["--eval-interval", "0"]);
    learner.process.assert_succeeds(PATIENCE);
    let snapshot = fs::read(learner.snapshot(SHORT.steps)).unwrap();
    fs::write("cut.safetensors", &snapshot[..snapshot.len() / 2]).unwrap();
    // Of the same length, so that the rest of the file stays what it is.
    let at = snapshot.windows(6).position(|window| window == b"hopper").unwrap();
    fs::write("moon.safetensors", [&snapshot[..at], b"onmoon", &snapshot[at + 6..]].concat())
        .unwrap();

    write_log(Path::new("strong.hdf5"), 30.0);
    write_log(Path::new("robot.hdf5"), 1.0);
    for (run, flags) in [("quad", ""), ("iql", "--agent value.hidden=[32]")] {
        train("robot.hdf5", &format!("robots/{run}"), &format!("--algorithm {run} {flags}"));
        let copy = ["env", "data"].map(|name| format!("{name}/{run}"));
        for folder in copy {
            fs::create_dir_all(format!("{folder}/snapshots")).unwrap();
            for file in ["config.toml", "snapshots/step_000000020.safetensors"] {
                fs::copy(format!("robots/{run}/{file}"), format!("{folder}/{file}")).unwrap();
            }
        }
    }
    let config = fs::read_to_string("robots/iql/config.toml").unwrap();
    let other = config.replace("environment = \"my-robot\"", "environment = \"another\"");
    fs::write("env/iql/config.toml", other).unwrap();
    let sha256 = config.split("sha256 = \"").nth(1).unwrap().split('"').next().unwrap();
    fs::write("data/iql/config.toml", config.replace(sha256, &"0".repeat(64))).unwrap();
}
