//! Run folders that another user made: no command waits for a pipe or commands a terminal. What else
//! they cannot do is in foreign.trycmd.

use std::fs;
use std::os::unix::fs::symlink;
use std::process::{Command, Output};

use crate::learner;
use crate::run::Run;

/// Runs a command for at most ten minutes, and in memory that is a thousandth of what a list of a
/// trillion evaluations would take.
fn bounded(words: &str) -> Output {
    let script = "ulimit -v 8000000; exec timeout 600 \"$0\" \"$@\"";
    let mut command = Command::new("sh");
    command.args(["-c", script, env!("CARGO_BIN_EXE_learner")]);
    command.args(words.split_whitespace()).output().unwrap()
}

#[test]
fn pipes_and_devices_in_a_run_block_no_command() {
    let folder = tempfile::tempdir().unwrap();
    let snapshot = "snapshots/step_000000010.safetensors";
    for name in
        ["config.toml", "scores.jsonl", "metrics.jsonl", "film.gif", "judgments.json", snapshot]
    {
        for is_pipe in [true, false] {
            let run = folder.path().join(format!("{}-{is_pipe}", name.replace('/', "-")));
            let mut begun = Run::new("hopper-demo", 0).set("experiment.eval_interval", 10);
            begun.score(10, 0, 5.0, "00");
            begun.write(&run);
            let file = run.join(name);
            fs::remove_file(&file).ok();
            match is_pipe {
                true => drop(Command::new("mkfifo").arg(&file).status().unwrap()),
                false => symlink("/dev/zero", &file).unwrap(),
            }
            let [dir, out] = [run.clone(), run.join("out")].map(|path| path.display().to_string());
            for command in [
                format!("list {dir}"),
                format!("report {dir} --html {out}"),
                format!("verify {dir}"),
                format!("judge {dir}"),
                format!("export {dir} --out {out}"),
            ] {
                let output = bounded(&command);
                let code = output.status.code();
                assert!(code.is_some_and(|code| code < 2), "{command} {name}: {output:?}");
            }
        }
    }
}

/// A terminal takes them for commands.
#[test]
fn no_control_character_of_a_run_is_printed() {
    let folder = tempfile::tempdir().unwrap();
    let [named, damaged] = ["named", "damaged\u{1b}]0;x\u{7}"].map(|name| folder.path().join(name));
    let name = "mine \u{1b}]0;x\u{7}\u{9b}2J\r";
    Run::new("hopper-demo", 0).set("run.preset", name).write(&named);
    Run::new("hopper-demo", 0).write(&damaged);
    fs::write(damaged.join("scores.jsonl"), "{\"step\":10}\n").unwrap();
    let [all, named, damaged] = [folder.path(), &named, &damaged].map(|path| path.display());
    for command in [
        format!("report {named}"),
        format!("report {all}"),
        format!("list {all}"),
        format!("verify {damaged}"),
        format!("verify {named} {damaged}"),
    ] {
        let Output { stdout, stderr, .. } = learner(&command);
        let text = String::from_utf8([stdout, stderr].concat()).unwrap();
        let is_command = |c: char| c.is_control() && !"\n\t".contains(c);
        assert!(!text.contains(is_command), "{command}: {text:?}");
    }
}
