//! Command lines and what they print: the transcripts beside this file. `TRYCMD=overwrite cargo
//! test …` writes anew what is printed.

use std::env;
use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;

use quad_tests::certificates::Certificates;
use quad_tests::peers;
use quad_tests::process::{Process, built, stdout, succeeds};
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
    let repository = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
    let transcripts = repository.join("tests/tests/programs");
    let programs = built("learner").parent().unwrap().display().to_string();
    let cases = trycmd::TestCases::new();
    cases
        .register_bins(["learner", "evaluator"].map(|name| (name, built(name))))
        .register_bins(["sh", "flock"].map(|name| (name, Path::new("/usr/bin").join(name))))
        .register_bin("complete.sh", transcripts.join("complete.sh"))
        .register_bin("certificates.sh", repository.join("deploy/zenoh/certificates.sh"))
        .env("PATH", format!("{programs}:{}", env::var("PATH").unwrap()))
        .env("LC_ALL", "C")
        .env("HOME", scratch.path().to_str().unwrap())
        .env("DEPLOY", repository.join("deploy").to_str().unwrap())
        .env("NO_LOCKS", built("examples/libno_locks.so").to_str().unwrap())
        .env("TAKEN", taken.local_addr().unwrap().to_string())
        // Nothing but this machine can be reached: the proxy for everything else is a closed port.
        .env("ALL_PROXY", "http://127.0.0.1:9")
        .env("NO_PROXY", "127.0.0.1")
        .env("QUAD_DATASETS_URL", "http://127.0.0.1:9")
        .env("D4RL_DATASET_DIR", "cache");
    for name in ["usage", "shell", "runs", "data", "datasets", "doctor", "policies", "judge"] {
        cases.case(transcripts.join(format!("{name}.trycmd")));
    }
    let mirror = peers::python("numpy, http.server").map(|python| {
        let script = |name: &str, argument: &str| {
            let mut command = Command::new(&python);
            command.arg(repository.join("tests/peers").join(name)).arg(argument);
            command
        };
        let file = ".ogbench/data/antmaze-medium-navigate-v0.npz";
        stdout(&script("standing.py", file).output().unwrap());
        let mirror = Process::start("mirror", scratch.path(), script("mirror.py", "mirror"));
        cases.env("MIRROR", mirror.wait_for_address(" listens"));
        for name in ["ogbench", "fetch"] {
            cases.case(transcripts.join(format!("{name}.trycmd")));
        }
        mirror
    });
    if let [Some(certificates), Some(elsewhere)] = [(); 2].map(|()| Certificates::make()) {
        fs::rename(certificates.folder(), "certificates").unwrap();
        fs::rename(elsewhere.folder(), "elsewhere").unwrap();
        cases.case(transcripts.join("certificates.trycmd"));
    }
    cases.run();
    drop(mirror);
}

/// Files that are no datasets, an evaluator that cannot start, a cache of datasets, and a mirror: of
/// its dataset only the file's name is known, so that any HDF5 file will do.
const FILES: &str = r#"
    mkdir broken cache other mirror .ogbench .ogbench/data
    head -c 27192 tiny.hdf5 >half.hdf5
    printf 'my notes' >notes.hdf5
    printf '#!/bin/sh\necho libmujoco.so: cannot open shared object file >&2; exit 127\n' >broken/evaluator
    chmod +x broken/evaluator
    cp "$1" broken
    touch cache/hopper_random-v2.hdf5
    printf 'half of it' >cache/hopper_medium-v2.hdf5
    printf 'name = "x"\nlist = [\n' >other/config.toml
    cp tiny.hdf5 mirror/hopper_random-v2.hdf5
"#;

fn write_files(scratch: &Scratch) {
    scratch.preset("tiny", SHORT);
    let mut sh = Command::new("sh");
    stdout(&sh.args(["-ec", FILES, "sh"]).arg(built("learner")).output().unwrap());
    fs::copy("tiny.hdf5", "without-infos.hdf5").unwrap();
    hdf5::File::open_rw("without-infos.hdf5").unwrap().unlink("infos").unwrap();
    succeeds("evaluator collect --env walker2d --transitions 500 --out walker.hdf5");
}

/// A run without evaluations, snapshots that are not what they should be, and two runs on a log.
fn write_run(scratch: &Scratch) {
    let mut learner = scratch.learner_with("run", SHORT, &["--eval-interval", "0"]);
    learner.process.assert_ends(0);
    let snapshot = fs::read(learner.snapshot(SHORT.steps)).unwrap();
    fs::write("cut.safetensors", &snapshot[..snapshot.len() / 2]).unwrap();
    // Of the same length, so that the rest of the file stays what it is.
    let place = snapshot.windows(6).position(|window| window == b"hopper").unwrap();
    let moon = [&snapshot[..place], b"onmoon", &snapshot[place + 6..]].concat();
    fs::write("moon.safetensors", moon).unwrap();

    write_log(Path::new("strong.hdf5"), 30.0);
    write_log(Path::new("robot.hdf5"), 1.0);
    for (run, flags) in [("quad", "--agent chunk=2"), ("iql", "--agent value.hidden=[32]")] {
        let flags = format!("--algorithm {run} {flags}");
        stdout(&train("robot.hdf5", &format!("robots/{run}"), &flags));
    }
    for folder in ["env", "data"] {
        stdout(&Command::new("cp").args(["-r", "robots", folder]).output().unwrap());
    }
    let config = fs::read_to_string("robots/iql/config.toml").unwrap();
    let other = config.replace("environment = \"my-robot\"", "environment = \"another\"");
    fs::write("env/iql/config.toml", other).unwrap();
    let sha256 = config.split("sha256 = \"").nth(1).unwrap().split('"').next().unwrap();
    fs::write("data/iql/config.toml", config.replace(sha256, &"0".repeat(64))).unwrap();
}
