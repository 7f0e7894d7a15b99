//! Tells the binaries where libmujoco lies, so that no user has to set LD_LIBRARY_PATH.

use std::path::Path;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // In the clone it was built in, then for an image or a copied folder: beside the binary, in a sibling lib folder
    // (/usr/local/bin → /usr/local/lib), in the clone's .deps when the binary lies in target/<profile>.
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("/"));
    println!("cargo::rustc-link-arg=-Wl,-rpath,{}", workspace.join(".deps/mujoco").display());
    for folder in ["$ORIGIN", "$ORIGIN/../lib", "$ORIGIN/../../.deps/mujoco"] {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
}
