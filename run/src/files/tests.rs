//! Tests of files, and of all code that opens files without this module.

use super::*;

/// Calls that open or make a file, without `File::create_new`, which never opens an existing one.
const CALLS: &str = "File::create File::open File::options OpenOptions \
                     fs::copy fs::read fs::read_to_string fs::write";
/// Crates of the programs.
const SOURCES: &str = "algorithms dataset evaluator learner nn python run runtime";
/// Allowed calls: file and part of the line.
const ALLOWED: [(&str, &str); 13] = [
    // The system's own files.
    ("", "\"/proc/"),
    ("run/src/folder/lock.rs", "fs::read_to_string(HOST)"),
    ("runtime/src/metrics_server.rs", "fs::read_to_string(path)"),
    // The one way, and a folder to synchronize.
    ("run/src/files.rs", "OpenOptions"),
    ("run/src/files.rs", "File::open(folder"),
    // The user names it; it may be a pipe of a shell.
    ("run/src/config/presets.rs", "fs::read_to_string(preset)"),
    ("learner/src/sweep/study.rs", "fs::read_to_string(path)"),
    // Data that the user names.
    ("dataset/src/formats/hdf5_file.rs", "File::open(path)"),
    ("dataset/src/formats/npz_file.rs", "File::open(path)"),
    ("dataset/src/formats/foreign.rs", "File::open(path)"),
    ("dataset/src/formats/minari.rs", "fs::read(&path)"),
    ("dataset/src/formats/foreign.rs", "fs::read(folder"),
    // A file that it has just made.
    ("dataset/src/formats/new_file.rs", "File::open(&self.partial)"),
];

/// True if a line of code has one of [`CALLS`].
fn is_call(line: &str) -> bool {
    let is_part = |c: char| c.is_alphanumeric() || c == '_';
    let is_whole = |start: usize, call: &str| {
        !line[..start].ends_with(is_part) && !line[start + call.len()..].starts_with(is_part)
    };
    let mut calls = CALLS.split(' ').flat_map(|call| line.match_indices(call));
    !line.starts_with("//") && !line.starts_with("use ") && calls.any(|(i, call)| is_whole(i, call))
}

#[test]
fn no_program_opens_files_in_another_way() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let mut folders = Vec::from_iter(SOURCES.split(' ').map(|name| root.join(name).join("src")));
    let (mut files, mut used) = (0, [false; ALLOWED.len()]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap().flatten() {
            let (path, name) = (entry.path(), entry.file_name().into_string().unwrap());
            if path.is_dir() && name != "tests" {
                folders.push(path);
                continue;
            }
            if !name.ends_with(".rs") || ["tests.rs", "fixtures.rs"].contains(&&*name) {
                continue;
            }
            files += 1;
            let (text, name) =
                (fs::read_to_string(&path).unwrap(), path.strip_prefix(root).unwrap());
            let code = text.split("\nmod tests {").next().unwrap_or_default();
            for line in code.lines().map(str::trim).filter(|line| is_call(line)) {
                let is_allowed =
                    |(file, part): &(&str, &str)| name.starts_with(file) && line.contains(part);
                let index = ALLOWED.iter().position(is_allowed);
                used[index.unwrap_or_else(|| panic!("{name:?}: {line}\nUse quad_run::files."))] =
                    true;
            }
        }
    }
    assert!(files > 200, "the sources are elsewhere");
    for (allowed, used) in ALLOWED.iter().zip(used) {
        assert!(used, "no such call: {allowed:?}");
    }
}

#[test]
fn links_are_followed_only_where_the_user_names_them() {
    let folder = tempfile::tempdir().unwrap();
    let [file, link, zero] = ["file", "link", "zero"].map(|name| folder.path().join(name));
    replace(&file, b"text").unwrap();
    std::os::unix::fs::symlink(&file, &link).unwrap();
    std::os::unix::fs::symlink("/dev/zero", &zero).unwrap();
    assert_eq!(read_named(&link).unwrap(), b"text");
    let appended = append(&link).map(|_| Vec::new());
    for refused in [read(&link), read(&zero), read_named(&zero), appended] {
        let error = refused.unwrap_err().to_string();
        assert!(error.starts_with("it is a link, a pipe"));
    }
    let error = read_named(folder.path()).unwrap_err().to_string();
    assert_eq!(error, "it is a folder, not a file");
    assert_eq!(read(&folder.path().join("none")).unwrap_err().kind(), ErrorKind::NotFound);
}

#[test]
fn replacing_a_file_leaves_no_other_file() {
    let folder = tempfile::tempdir().unwrap();
    let [file, taken] = ["file", "taken"].map(|name| folder.path().join(name));
    replace(&file, b"old").unwrap();
    replace(&file, b"new").unwrap();
    fs::create_dir(&taken).unwrap();
    assert!(replace(&taken, b"new").is_err());
    assert_eq!(read_text(&file).unwrap(), "new");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn reads_the_rest_of_a_file_up_to_a_limit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log");
    append(&path).unwrap().write_all(b"first, second").unwrap();
    append(&path).unwrap().write_all(b", third").unwrap();
    let mut file = open(&path).unwrap();
    assert_eq!(rest(&mut file, 7).unwrap(), b"second, third");
    assert_eq!(rest(&mut file, 99).unwrap(), b"");
    append(&path).unwrap().set_len(LARGEST + 8).unwrap();
    assert_eq!(rest(&mut file, 7).unwrap_err().kind(), ErrorKind::FileTooLarge);
    assert_eq!(rest(&mut file, LARGEST).unwrap(), [0; 8]);
}

#[test]
fn several_may_make_a_folder_at_once() {
    let folder = tempfile::tempdir().unwrap();
    for round in 0..20 {
        let path = folder.path().join(format!("{round}/runs/mine"));
        let begin = std::sync::Barrier::new(8);
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    begin.wait();
                    create_folder(&path).unwrap();
                });
            }
        });
        assert!(path.is_dir());
    }
}
