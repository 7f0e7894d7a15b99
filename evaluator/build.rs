//! Sets the binaries' search path for libmujoco, and lists the models.

use std::path::Path;
use std::{env, fs, io};

fn main() -> io::Result<()> {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=assets");
    let mut models = String::new();
    for entry in fs::read_dir("assets")? {
        let path = entry?.path().canonicalize()?;
        let name = path.file_stem().unwrap_or_default();
        models += &format!("({name:?}, include_str!({path:?})),");
    }
    let out = env::var_os("OUT_DIR").unwrap_or_default();
    fs::write(Path::new(&out).join("models.rs"), format!("&[{models}]"))?;
    // In an image, an archive, a wheel or a copied folder: beside the binary, or in a sibling lib
    // folder (/usr/local/bin → /usr/local/lib).
    let mut folders = vec!["$ORIGIN".to_owned(), "$ORIGIN/../lib".to_owned()];
    // The clone's .deps: at its path now, and beside target/<profile>. Programs for other machines
    // do without.
    if env::var_os("CARGO_FEATURE_STATIC").is_none() {
        let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("/"));
        folders.insert(0, workspace.join(".deps/mujoco").display().to_string());
        folders.push("$ORIGIN/../../.deps/mujoco".to_owned());
    }
    for folder in folders {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
    Ok(())
}
