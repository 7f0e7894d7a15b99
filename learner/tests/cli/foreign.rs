//! Run folders that another user made.

use std::fs;
use std::os::unix::fs::symlink;
use std::process::{Command, Output};

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
    for (run, film, is_shown) in [
        ("link", None, false),
        ("text", Some(secret.as_bytes()), false),
        ("film", Some(&whole[..]), true),
    ] {
        Run::new("hopper-demo", 0).write(&path(run));
        match film {
            Some(bytes) => fs::write(path(run).join("film.gif"), bytes).unwrap(),
            None => symlink(path("secret.gif"), path(run).join("film.gif")).unwrap(),
        }
        let page = path("page.html");
        let output =
            learner(&["report", path(run).to_str().unwrap(), "--html", page.to_str().unwrap()]);
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
    let [run, figures, outside] =
        ["run", "figures", "outside"].map(|name| folder.path().join(name));
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
    let snapshot = "snapshots/step_000000010.safetensors";
    for name in
        ["config.toml", "scores.jsonl", "metrics.jsonl", "film.gif", "judgments.json", snapshot]
    {
        for is_pipe in [true, false] {
            let run = folder.path().join(format!("{}-{is_pipe}", name.replace('/', "-")));
            let mut begun =
                Run::new("hopper-demo", 0).set(&[("experiment.eval_interval", 10.into())]);
            begun.score(10, 0, 5.0, "00");
            begun.write(&run);
            fs::remove_file(run.join(name)).ok();
            match is_pipe {
                true => {
                    assert!(Command::new("mkfifo").arg(run.join(name)).status().unwrap().success())
                }
                false => symlink("/dev/zero", run.join(name)).unwrap(),
            }
            let out = run.join("out");
            let [dir, out] = [&run, &out].map(|path| path.to_str().unwrap());
            for command in [
                &["list", dir][..],
                &["report", dir, "--html", out],
                &["verify", dir],
                &["judge", dir],
                &["export", dir, "--out", out],
            ] {
                let output = bounded(command);
                assert!(
                    output.status.code().is_some_and(|code| code < 2),
                    "{command:?} {name}: {output:?}"
                );
            }
        }
    }
}

#[test]
fn no_link_beside_a_report_is_written_through() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::write(path("precious"), "precious").unwrap();
    let mut run = Run::new("hopper-demo", 0);
    run.score(1000, 0, 5.0, "00");
    run.write(&path("run"));
    for name in
        ["page.html.partial", "curve-hopper-demo.svg.partial", "curve-hopper-demo.png.partial"]
    {
        symlink(path("precious"), path(name)).unwrap();
    }
    let [run, page, figures] =
        ["run", "page.html", "."].map(|name| path(name).to_str().unwrap().to_owned());
    printed(&["report", &run, "--html", &page, "--figures", &figures]);
    assert!(path("curve-hopper-demo.svg").exists());
    assert_eq!(fs::read_to_string(path("precious")).unwrap(), "precious");
}

/// A terminal takes them for commands.
#[test]
fn no_control_character_of_a_run_is_printed() {
    let folder = tempfile::tempdir().unwrap();
    let [named, damaged] =
        ["named", "damaged \u{1b}]0;x\u{7}"].map(|name| folder.path().join(name));
    Run::new("hopper-demo", 0)
        .set(&[("run.preset", "mine \u{1b}]0;x\u{7}\u{9b}2J\r".into())])
        .write(&named);
    Run::new("hopper-demo", 0).write(&damaged);
    fs::write(damaged.join("scores.jsonl"), "{\"step\":10}\n").unwrap();
    let [all, named, damaged] =
        [folder.path(), &named, &damaged].map(|path| path.to_str().unwrap());
    let looks =
        [["report", named], ["report", all], ["list", all], ["verify", damaged], ["verify", named]];
    for look in looks.iter().map(|look| &look[..]).chain([&["verify", named, damaged][..]]) {
        let Output { stdout, stderr, .. } = learner(look);
        for text in [stdout, stderr] {
            let text = String::from_utf8(text).unwrap();
            let is_command = |c: char| c.is_control() && !"\n\t".contains(c);
            assert!(!text.contains(is_command), "{look:?}: {text:?}");
        }
    }
}
