//! A disk that is soon full.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A tmpfs, unmounted when dropped.
pub struct SmallDisk {
    path: PathBuf,
}

impl SmallDisk {
    /// Mounts a disk at `path`; `None` where that is not allowed.
    pub fn mount(path: &Path, megabytes: u32) -> Option<SmallDisk> {
        fs::create_dir_all(path).expect("the scratch folder is writable");
        let size = format!("size={megabytes}m");
        let mounted =
            Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs"]).arg(path).output();
        let mounted = mounted.is_ok_and(|output| output.status.success());
        if !mounted {
            eprintln!("without a disk of its own: mounting a tmpfs needs the rights of root");
        }
        mounted.then(|| SmallDisk { path: path.to_owned() })
    }

    pub fn fill(&self) {
        let mut file = File::create(self.filler()).expect("the disk is writable");
        while file.write_all(&[0; 4096]).is_ok() {}
    }

    pub fn clear(&self) {
        fs::remove_file(self.filler()).expect("it was filled");
    }

    fn filler(&self) -> PathBuf {
        self.path.join("filler")
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        Command::new("umount").arg("--lazy").arg(&self.path).status().ok();
    }
}
