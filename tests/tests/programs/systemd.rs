//! The systemd units, as systemd itself reads them.

use std::fs;
use std::path::Path;
use std::process::Command;

use quad_tests::process::binary;

#[test]
#[ignore = "needs systemd-analyze"]
fn systemd_understands_the_units_and_finds_them_hardened() {
    if Command::new("systemd-analyze").arg("--version").output().is_err() {
        eprintln!(
            "skipped, because there is no systemd-analyze; it is in Debian's package systemd"
        );
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for program in ["evaluator", "learner"] {
        let name = format!("quad-{program}.service");
        let installed = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/systemd").join(&name);
        let installed = fs::read_to_string(installed).unwrap();
        // The program lies here and not where it is installed; the commented lines are to be good,
        // too.
        let (there, built) = (format!("/usr/local/bin/{program}"), binary(program));
        assert!(installed.contains(&there), "{name}");
        let text = installed.replace(&there, built.to_str().unwrap());
        let text = text
            .replace("\n#LoadCredential", "\nLoadCredential")
            .replace("\n#Environment", "\nEnvironment");
        assert_eq!(text.matches("\nLoadCredential=").count(), 3, "{name}");
        let unit = folder.path().join(&name);
        fs::write(&unit, text).unwrap();
        for arguments in [&["verify"][..], &["security", "--offline=true", "--threshold=20"]] {
            let output =
                Command::new("systemd-analyze").args(arguments).arg(&unit).output().unwrap();
            let said =
                String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
            assert!(
                output.status.success() && !said.contains("Unknown"),
                "{name}, {arguments:?}:\n{said}"
            );
        }
    }
}
