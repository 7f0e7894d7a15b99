//! Tells the module where libmujoco lies.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // The wheel puts libmujoco into PREFIX/lib and the module into
    // PREFIX/lib/pythonX.Y/site-packages/quad_rl. With `pip install --target FOLDER`, they are in
    // FOLDER/lib and FOLDER/quad_rl.
    for folder in ["$ORIGIN/../../..", "$ORIGIN/../lib"] {
        println!("cargo::rustc-link-arg-cdylib=-Wl,-rpath,{folder}");
    }
}
