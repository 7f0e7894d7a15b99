//! Files that an independent implementation recorded replay here, up to their rounding to float32.
#![allow(clippy::unwrap_used)]

use std::path::Path;

use quad_dataset::environment::find;
use quad_evaluator::tools::verify::{environment_of, verify};

/// Median and 99th percentile of the error that the reference implementation itself has, replaying
/// the same file; rows whose next observation is known.
const FILES: [(&str, &str, f64, f64, usize); 3] = [
    ("halfcheetah_medium_replay", "halfcheetah", 6.2e-7, 2.9e-5, 100_000),
    ("walker2d_medium_replay", "walker2d", 3.8e-7, 6.9e-6, 101_998),
    ("antmaze_umaze", "antmaze-umaze", 2.6e-7, 1.6e-6, 70_000 - 930 - 98),
];

#[test]
fn recorded_files_replay() {
    for (file, name, median, p99, compared) in FILES {
        let path = Path::new("../../shared/data").join(file).with_extension("hdf5");
        if !path.exists() {
            eprintln!("skipped: there is no {}", path.display());
            continue;
        }
        let report = verify(&path, find(name).unwrap()).unwrap();
        assert_eq!((report.environment, report.compared), (name, compared));
        assert_eq!((report.rewards_differ, report.terminals_differ), (0, 0), "{report:?}");
        // Their sizes fit several environments, so a person has to say which.
        let error = environment_of(&path).unwrap_err().to_string();
        assert!(error.contains("does not say which environment it was recorded in"), "{error}");
        for (ours, reference) in [(report.obs_error.median, median), (report.obs_error.p99, p99)] {
            assert!(ours > reference / 2.0 && ours < reference * 2.0, "{name}: {report:?}");
        }
    }
}
