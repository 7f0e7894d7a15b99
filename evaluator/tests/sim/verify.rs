//! Replays files of an independent implementation, up to their rounding to float32.

use std::path::Path;

use quad_dataset::environment::find;
use quad_evaluator::tools::verify::{environment_of, verify};

/// Median and 99th percentile of the errors with which the reference implementation itself replays
/// a file; rows whose next observation is known.
const FILES: [(&str, [f64; 2], usize); 3] = [
    ("halfcheetah_medium_replay", [6.2e-7, 2.9e-5], 100_000),
    ("walker2d_medium_replay", [3.8e-7, 6.9e-6], 101_998),
    ("antmaze_umaze", [2.6e-7, 1.6e-6], 70_000 - 930 - 98),
];

#[test]
fn recorded_files_replay() {
    for (file, reference, compared) in FILES {
        let name = file.trim_end_matches("_medium_replay").replace('_', "-");
        let path = Path::new("../../shared/data").join(file).with_extension("hdf5");
        if !path.exists() {
            eprintln!("skipped: there is no {}", path.display());
            continue;
        }
        let report = verify(&path, find(&name).unwrap()).unwrap();
        assert_eq!((report.environment, report.compared), (&*name, compared));
        assert_eq!((report.rewards_differ, report.terminals_differ), (0, 0), "{report:?}");
        // Their sizes fit several environments.
        let error = environment_of(&path).unwrap_err().to_string();
        assert!(error.contains("does not say which environment it was recorded in"), "{error}");
        let errors = [report.obs_error.median, report.obs_error.p99];
        for (ours, reference) in errors.into_iter().zip(reference) {
            assert!(ours > reference / 2.0 && ours < reference * 2.0, "{name}: {report:?}");
        }
    }
}
