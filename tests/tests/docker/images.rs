//! The images, made once for all tests.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::LazyLock;

/// Makes sure that there are images of what is in this folder now. If there cannot be any, says why, and is false.
pub fn are_there() -> bool {
    static MADE: LazyLock<Result<(), String>> = LazyLock::new(|| base_images().and_then(|()| build()));
    if let Err(reason) = &*MADE {
        eprintln!("skipped, because {reason}");
    }
    MADE.is_ok()
}

fn build() -> Result<(), String> {
    let mut command = Command::new("docker");
    command.current_dir(repository()).args(["compose", "build", "--quiet", "learner", "evaluator"]);
    // That ours cannot be built is a failure, and nothing to skip a test for.
    assert!(succeeds(&mut command), "the images cannot be built");
    Ok(())
}

/// Makes stand-ins for the images which ours are made from, and for those of router and Prometheus, where a script can.
/// Everywhere else, Docker fetches them.
fn base_images() -> Result<(), String> {
    if !succeeds(Command::new("docker").arg("info").stderr(Stdio::null())) {
        return Err("no Docker engine answers".to_owned());
    }
    let beside = repository().join("../shared/docker/stand-ins");
    let stand_ins = std::env::var_os("QUAD_STAND_INS").map_or(beside, PathBuf::from);
    if !stand_ins.exists() {
        return Ok(());
    }
    let named = ["docker-compose.yml", "deploy/Dockerfile"]
        .map(|file| std::fs::read_to_string(repository().join(file)).expect("the repository has its files"));
    let lines = named.iter().flat_map(|text| text.lines());
    let images =
        lines.filter_map(|line| line.trim().strip_prefix("image: ").or(line.strip_prefix("FROM "))?.split(' ').next());
    // Our own and the Dockerfile's stages have no tag; Grafana is scaled to none.
    let images = images.filter(|image| image.contains(':') && !image.starts_with("grafana/"));
    match succeeds(Command::new(&stand_ins).args(images)) {
        true => Ok(()),
        false => Err(format!("{} failed", stand_ins.display())),
    }
}

fn succeeds(command: &mut Command) -> bool {
    command.stdout(Stdio::null()).status().is_ok_and(|status| status.success())
}

/// The folder that everything is in.
pub fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}
