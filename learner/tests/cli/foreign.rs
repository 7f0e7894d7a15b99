//! Run folders that another user made.

use std::fs;
use std::os::unix::fs::symlink;
use std::process::{Command, Output};

use serde_json::{Value, json};

use crate::run::Run;
use crate::{learner, printed};

/// Runs a command for at most ten minutes, and in memory that is a thousandth of what a list of a
/// trillion evaluations would take.
fn bounded(words: &str) -> Output {
    let script = "ulimit -v 8000000; exec timeout 600 \"$0\" \"$@\"";
    let mut command = Command::new("sh");
    command.args(["-c", script, env!("CARGO_BIN_EXE_learner")]);
    command.args(words.split_whitespace()).output().unwrap()
}

#[test]
fn a_report_contains_films_and_no_other_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let secret = "a secret of the report's reader";
    let film = [b"GIF89a", secret.as_bytes()].concat();
    fs::write(path("secret.gif"), &film).unwrap();
    for (run, film, is_shown) in [
        ("link", None, false),
        ("text", Some(secret.as_bytes()), false),
        ("film", Some(&film[..]), true),
    ] {
        Run::new("hopper-demo", 0).write(path(run));
        match film {
            Some(bytes) => fs::write(path(run).join("film.gif"), bytes).unwrap(),
            None => symlink(path("secret.gif"), path(run).join("film.gif")).unwrap(),
        }
        let page = path("page.html");
        let output = learner(&format!("report {} --html {}", path(run).display(), page.display()));
        let page = fs::read_to_string(page).unwrap();
        assert_eq!(page.contains("data:image/gif"), is_shown, "{run}");
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(said.contains("film.gif is not in the report"), !is_shown, "{said}");
    }
}

#[test]
fn a_runs_name_leads_to_no_other_folder() {
    let folder = tempfile::tempdir().unwrap();
    let [run, figures, outside] =
        ["run", "figures", "outside"].map(|name| folder.path().join(name));
    for path in [&figures.join("curve-.."), &outside] {
        fs::create_dir_all(path).unwrap();
    }
    let mut named = Run::new("hopper-demo", 0).set("run.preset", "../../outside/x");
    named.score(1000, 0, 5.0, "00");
    named.write(&run);
    printed(&format!("report {} --figures {}", run.display(), figures.display()));
    assert_eq!(fs::read_dir(&outside).unwrap().count(), 0);
    assert!(figures.join("curve-..-..-outside-x.svg").exists());

    for name in ["../../outside/evil", "..", ""] {
        Run::new("hopper-demo", 0).set("run.name", name).write(&run);
        let refused = learner(&format!("report {}", run.display()));
        let said = String::from_utf8(refused.stderr).unwrap();
        assert!(!refused.status.success() && said.contains("config.toml, line "), "{name}: {said}");
    }
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

#[test]
fn a_run_that_plans_more_evaluations_than_fit_into_memory_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let mut run = Run::new("hopper-demo", 0).sizes(1_000_000_000_000_000, 1, 1000);
    (0..1000).for_each(|seed| run.score(1, seed, 5.0, "00"));
    run.write(folder.path());
    let look = |command: &str| {
        let output = bounded(&format!("{command} {}", folder.path().display()));
        String::from_utf8(output.stdout).unwrap()
    };
    let report: Value = serde_json::from_str(&look("report --json")).unwrap();
    assert_eq!(report["runs"][0]["episodes_missing"], json!(999_999_999_999_999_000i64));
    assert!(look("report").contains("1 of 1000000000000000 evaluations are complete"));
    assert!(look("list").contains("5.0 @1"));
    assert!(look("verify").contains("without a score (1000000000000000000): step 1, seed "));
}

#[test]
fn no_link_beside_a_report_is_written_through() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::write(path("precious"), "precious").unwrap();
    let mut run = Run::new("hopper-demo", 0);
    run.score(1000, 0, 5.0, "00");
    run.write(path("run"));
    for name in ["page.html", "curve-hopper-demo.svg", "curve-hopper-demo.png"] {
        symlink(path("precious"), path(&format!("{name}.partial"))).unwrap();
    }
    let dir = folder.path().display();
    printed(&format!("report {dir}/run --html {dir}/page.html --figures {dir}"));
    assert!(path("curve-hopper-demo.svg").exists());
    assert_eq!(fs::read_to_string(path("precious")).unwrap(), "precious");
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
