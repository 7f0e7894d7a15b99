//! Tells the binaries where libmujoco lies, so that no user has to set LD_LIBRARY_PATH, and lists
//! the models.

use std::path::{Path, PathBuf};
use std::{env, fs, io};

fn main() -> io::Result<()> {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=assets");
    let models: Vec<PathBuf> = fs::read_dir("assets")?
        .map(|entry| entry?.path().canonicalize())
        .collect::<io::Result<_>>()?;
    let list = models.iter().map(|path| {
        format!("({:?}, include_str!({path:?})),", path.file_stem().unwrap_or_default())
    });
    let out = env::var_os("OUT_DIR").unwrap_or_default();
    fs::write(Path::new(&out).join("models.rs"), format!("&[{}]", list.collect::<String>()))?;
    // For an image, an archive, a wheel or a copied folder: beside the binary, or in a sibling lib
    // folder (/usr/local/bin → /usr/local/lib).
    let mut folders = vec!["$ORIGIN".to_owned(), "$ORIGIN/../lib".to_owned()];
    // The clone's .deps: where it is now, and beside target/<profile>. Not in a program that is
    // made for other machines.
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
