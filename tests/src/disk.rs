//! Disks that are full, hang, or lose their power.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::process::preload;

/// A filesystem, unmounted when dropped.
struct Mount {
    path: PathBuf,
}

impl Mount {
    /// `None` where that is not allowed.
    fn new(path: &Path, arguments: &[&str]) -> Option<Mount> {
        fs::create_dir_all(path).expect("the scratch folder is writable");
        let output = Command::new("mount").args(arguments).arg(path).output();
        let is_mounted = output.is_ok_and(|output| output.status.success());
        if !is_mounted {
            eprintln!("without a disk of its own: mounting one needs the rights of root");
        }
        is_mounted.then(|| Mount { path: path.to_owned() })
    }
}

impl Drop for Mount {
    fn drop(&mut self) {
        Command::new("umount").arg("--lazy").arg(&self.path).status().ok();
    }
}

/// A tmpfs.
pub struct SmallDisk(Mount);

impl SmallDisk {
    pub fn mount(path: &Path, megabytes: u32) -> Option<SmallDisk> {
        let size = format!("size={megabytes}m");
        Mount::new(path, &["-t", "tmpfs", "-o", &size, "tmpfs"]).map(SmallDisk)
    }

    pub fn fill(&self) {
        let mut file = File::create(self.0.path.join("filler")).expect("the disk is writable");
        while file.write_all(&[0; 4096]).is_ok() {}
    }

    pub fn grow(&self) {
        let mut mount = Command::new("mount");
        let status = mount.args(["-o", "remount,size=64m"]).arg(&self.0.path).status();
        assert!(status.unwrap().success());
    }
}

/// A filesystem in a file, as which it would be after a power cut: without what has not been
/// synchronized.
pub struct LosingDisk {
    image: PathBuf,
    mount: Option<Mount>,
}

impl LosingDisk {
    pub fn mount(path: &Path) -> Option<LosingDisk> {
        let image = path.with_extension("image");
        File::create(&image).and_then(|file| file.set_len(64 << 20)).expect("there is room");
        let made = Command::new("mkfs.ext4").args(["-q", "-F"]).arg(&image).status();
        made.ok().filter(|status| status.success())?;
        let mount = mount_image(&image, path)?;
        Some(LosingDisk { image, mount: Some(mount) })
    }

    /// Cuts the power; nothing may run on it.
    pub fn cut_power(&mut self) {
        let path = self.mount.as_ref().expect("it is mounted").path.clone();
        let after = self.image.with_extension("after");
        fs::copy(&self.image, &after).expect("there is room");
        self.mount = None;
        fs::rename(after, &self.image).expect("the scratch folder is writable");
        self.mount = mount_image(&self.image, &path);
    }
}

fn mount_image(image: &Path, path: &Path) -> Option<Mount> {
    Mount::new(path, &["-o", "loop", image.to_str().expect("a path is text")])
}

/// Variable with the beginning of the files' paths, for examples/hanging_disk.rs.
pub const HANGS: &str = "QUAD_TEST_HANGS";

/// Command line prefix of a program in which `fsync` never returns for paths that begin with
/// `file`.
pub fn hanging(file: &Path) -> Vec<String> {
    let mut words = preload("hanging_disk");
    words.push(format!("{HANGS}={}", file.display()));
    words
}
