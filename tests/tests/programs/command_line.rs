//! What scripts rely on: exit codes, hints, help.

use std::process::{Command, Output};

use quad_tests::PATIENCE;
use quad_tests::process::{assert_refused, binary};
use quad_tests::setting::SHORT;
use quad_tests::system::Scratch;

fn run(program: &str, arguments: &[&str]) -> Output {
    Command::new(binary(program)).args(arguments).output().unwrap()
}

/// `learner train` with those arguments must end with that exit code, after it said those words.
fn refused(arguments: &[&str], code: i32, words: &[&str]) {
    let output = run("learner", &[&["train"], arguments].concat());
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {text}");
    assert!(words.iter().all(|word| text.contains(word)), "{arguments:?}: {text}");
}

#[test]
fn a_wrong_command_line_exits_with_2() {
    for (program, arguments) in [
        ("learner", &[][..]),
        ("learner", &["train"]),
        ("learner", &["presets", "no-such-task"]),
        ("evaluator", &[]),
        ("evaluator", &["serve", "--name", "not a name"]),
        ("evaluator", &["serve", "--http", "everywhere"]),
        ("evaluator", &["serve", "--connect", "127.0.0.1:7447"]),
        ("evaluator", &["collect", "--env", "hopper"]),
        ("evaluator", &["score"]),
        ("evaluator", &["score", "x", "--candidates", "1,0"]),
        ("evaluator", &["score", "x", "--rule", "softmax"]),
    ] {
        let output = run(program, arguments);
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{program} {arguments:?}: {text}");
    }
}

#[test]
fn more_threads_than_the_system_has_are_an_error_and_not_a_panic() {
    let mut shell = Command::new("sh");
    shell.args(["-c", "ulimit -v 1000000; exec \"$0\" completions bash"]).arg(binary("evaluator"));
    let output = shell.env("RAYON_NUM_THREADS", "60000").output().unwrap();
    assert_refused(&output, "cannot start the threads", "RAYON_NUM_THREADS");
}

#[test]
fn what_is_missing_is_said() {
    refused(
        &["--task", "hopper-demo"],
        1,
        &["hint:", "hopper-demo names no dataset", "--dataset FILE"],
    );
    refused(&["--task", "own-data"], 1, &["hint:", "own-data names no dataset", "docs/data.md"]);
    let missing = [
        "--task",
        "hopper-demo",
        "--dataset",
        "/tmp/missing.hdf5",
        "--run-dir",
        "/tmp/missing-run",
    ];
    refused(&missing, 1, &["hint:", "/tmp/missing.hdf5"]);
}

/// What a command writes in a shell.
fn shell(command: &[&str]) -> String {
    let path = binary("learner").parent().unwrap().display().to_string()
        + ":"
        + &std::env::var("PATH").unwrap();
    let output = Command::new(command[0]).args(&command[1..]).env("PATH", path).output().unwrap();
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
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
        assert_eq!(
            shell(&["bash", "--norc", "-euc", &script]).trim(),
            completed,
            "{program} {typed}"
        );
    }
}

#[test]
fn a_terminal_is_colored_unless_its_user_does_not_want_it() {
    let scratch = Scratch::new();
    let [data, run] = [scratch.dataset(), scratch.path().join("run")];
    let flags = "--task hopper-demo --set batch_size=8 --dry-run";
    let train =
        format!("learner train {flags} --dataset {} --run-dir {}", data.display(), run.display());
    for (setting, colored) in [
        ("NO_COLOR= TERM=xterm", true),
        ("NO_COLOR=1 TERM=xterm", false),
        ("NO_COLOR= TERM=dumb", false),
    ] {
        let text =
            shell(&["script", "--quiet", "--command", &format!("{setting} {train}"), "/dev/null"]);
        assert!(text.contains(" INFO"), "{text}");
        assert_eq!(text.contains("\u{1b}["), colored, "{setting}: {text:?}");
    }
    assert!(
        !shell(&["sh", "-c", &format!("{train} 2>&1")]).contains('\u{1b}'),
        "a pipe has no colors"
    );
}

#[test]
fn a_learner_without_evaluations_waits_for_no_evaluator() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner_with("alone", SHORT, &["--eval-interval", "0"]);
    learner.process.assert_succeeds(PATIENCE);
    assert!(learner.scores().is_empty());
    assert!(learner.snapshot(SHORT.steps).exists(), "the last snapshot is kept");

    // What lies beside it is named and passed over, and is an error by itself.
    let other = scratch.path().join("other");
    let [folder, other] = [&learner.run_dir, &other].map(|path| path.to_str().unwrap());
    for (folders, code) in [(&[other, folder][..], 0), (&[other], 1)] {
        let output = run("learner", &[&["report"], folders].concat());
        let (text, said) =
            (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
        assert_eq!(output.status.code(), Some(code), "{folders:?}: {said}");
        assert!(
            said.contains(other) && text.contains("alone") == (code == 0),
            "{folders:?}: {said}{text}"
        );
    }
}
