//! Completion, colors and scripts in a shell. Exit codes and errors are in the transcripts.

use std::process::Command;

use quad_tests::process::{binary, stdout};
use quad_tests::system::Scratch;

/// The output of a command in which our programs are found.
fn shell(command: &[&str]) -> String {
    let programs = binary("learner").parent().unwrap().display().to_string();
    let path = format!("{programs}:{}", std::env::var("PATH").unwrap());
    stdout(&Command::new(command[0]).args(&command[1..]).env("PATH", path).output().unwrap())
}

#[test]
fn bash_completes_commands_and_arguments() {
    for (program, typed, completed) in [
        ("learner", "rep", "report"),
        ("learner", "train --dr", "--dry-run"),
        ("learner", "report --select la", "last"),
        ("learner", "train --algorithm one", "onestep"),
        ("learner", "train --task walker2d-d", "walker2d-demo"),
        ("evaluator", "film --comp", "--compare"),
    ] {
        // As bash calls it: the command, the word that is completed, and the one before it.
        let script = format!(
            r#"eval "$({program} completions bash)"; complete -p {program} >&2
            COMP_WORDS=({program} {typed}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
            _{program} {program} "${{COMP_WORDS[COMP_CWORD]}}" "${{COMP_WORDS[COMP_CWORD - 1]}}"; echo "${{COMPREPLY[@]}}""#
        );
        let found = shell(&["bash", "--norc", "-euc", &script]);
        assert_eq!(found.trim(), completed, "{program} {typed}");
    }
}

#[test]
fn scripts_explain_themselves_in_their_own_folder() {
    let deploy = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy");
    for (script, begin) in
        [("./demo.sh", "The demonstration: "), ("zenoh/certificates.sh", "Makes certificates ")]
    {
        let output = Command::new("bash").args([script, "--help"]).current_dir(deploy).output();
        let text = stdout(&output.unwrap());
        assert!(text.starts_with(begin), "{script}: {text}");
    }
}

#[test]
fn only_terminals_are_colored_and_only_if_their_user_wants_it() {
    let scratch = Scratch::new();
    let train = format!(
        "learner train --task hopper-demo --set batch_size=8 --dry-run --dataset {} --run-dir {}",
        scratch.dataset().display(),
        scratch.path().join("run").display()
    );
    for (setting, colored) in [
        ("NO_COLOR= TERM=xterm", true),
        ("NO_COLOR=1 TERM=xterm", false),
        ("NO_COLOR= TERM=dumb", false),
    ] {
        let command = format!("{setting} {train}");
        let text = shell(&["script", "--quiet", "--command", &command, "/dev/null"]);
        assert!(text.contains(" INFO"), "{text}");
        assert_eq!(text.contains("\u{1b}["), colored, "{setting}: {text:?}");
    }
    assert!(!shell(&["sh", "-c", &format!("{train} 2>&1")]).contains('\u{1b}'));
}
