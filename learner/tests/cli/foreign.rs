//! Run folders that another user made.

use std::fs;
use std::os::unix::fs::symlink;
use std::process::Command;

use crate::run::Run;
use crate::{bounded, learner, printed};

#[test]
fn a_report_takes_in_films_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let secret = "a secret of the report's reader";
    fs::write(path("secret"), secret).unwrap();
    let whole = [b"GIF89a", secret.as_bytes()].concat();
    fs::write(path("secret.gif"), &whole).unwrap();
    for (run, film, is_shown) in
        [("link", None, false), ("text", Some(secret.as_bytes()), false), ("film", Some(&whole[..]), true)]
    {
        Run::new("hopper-demo", 0).write(&path(run));
        match film {
            Some(bytes) => fs::write(path(run).join("film.gif"), bytes).unwrap(),
            None => symlink(path("secret.gif"), path(run).join("film.gif")).unwrap(),
        }
        let page = path("page.html");
        let output = learner(&["report", path(run).to_str().unwrap(), "--html", page.to_str().unwrap()]);
        assert!(output.status.success());
        let page = fs::read_to_string(page).unwrap();
        assert_eq!(page.contains("data:image/gif"), is_shown, "{run}");
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(said.contains("film.gif is not in the report"), !is_shown, "{said}");
    }
}

#[test]
fn what_a_run_calls_itself_leads_to_no_other_folder() {
    let folder = tempfile::tempdir().unwrap();
    let [run, figures, outside] = ["run", "figures", "outside"].map(|name| folder.path().join(name));
    for path in [&figures.join("curve-.."), &outside] {
        fs::create_dir_all(path).unwrap();
    }
    let mut named = Run::new("hopper-demo", 0).set(&[("run.preset", "../../outside/x".into())]);
    named.score(1000, 0, 5.0, "00");
    named.write(&run);
    printed(&["report", run.to_str().unwrap(), "--figures", figures.to_str().unwrap()]);
    assert_eq!(fs::read_dir(&outside).unwrap().count(), 0);
    assert!(figures.join("curve-..-..-outside-x.svg").exists());

    for name in ["../../outside/evil", "..", ""] {
        Run::new("hopper-demo", 0).set(&[("run.name", name.into())]).write(&run);
        let refused = learner(&["report", run.to_str().unwrap()]);
        let said = String::from_utf8(refused.stderr).unwrap();
        assert!(!refused.status.success() && said.contains("config.toml, line "), "{name}: {said}");
    }
}

/// A pipe that no program writes to, and a device without an end.
#[test]
fn what_is_no_file_holds_up_nobody_who_looks_at_the_run() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["config.toml", "scores.jsonl", "metrics.jsonl"] {
        for is_pipe in [true, false] {
            let run = folder.path().join(format!("{name}-{is_pipe}"));
            Run::new("hopper-demo", 0).write(&run);
            fs::remove_file(run.join(name)).ok();
            match is_pipe {
                true => assert!(Command::new("mkfifo").arg(run.join(name)).status().unwrap().success()),
                false => symlink("/dev/zero", run.join(name)).unwrap(),
            }
            for command in ["list", "report"] {
                let output = bounded(&[command, run.to_str().unwrap()]);
                assert!(output.status.code().is_some_and(|code| code < 2), "{command} {name}: {output:?}");
            }
        }
    }
}
