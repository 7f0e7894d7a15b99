//! With the feature `cuda`: tells the programs of this crate and of the learner where the CUDA
//! toolkit lies that they are linked with, so that the user need not set LD_LIBRARY_PATH.

use std::env;
use std::path::Path;

fn main() {
    println!("cargo::rerun-if-env-changed=CUDA_HOME");
    if let (Some(_), Some(toolkit)) = (env::var_os("CARGO_FEATURE_CUDA"), env::var_os("CUDA_HOME"))
    {
        println!(
            "cargo::rustc-link-arg=-Wl,-rpath,{}",
            Path::new(&toolkit).join("lib64").display()
        );
    }
}
