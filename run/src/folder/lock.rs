//! Locks that keep other processes out of a folder.

use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind, Write};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::Duration;

use rustix::io::Errno;

use super::error::{RunDirError, io_error};
use crate::files;

/// Pause before a second attempt: `learner list` holds a lock for microseconds.
const RETRY: Duration = Duration::from_millis(10);
/// Contains the name of this host.
const HOST: &str = "/proc/sys/kernel/hostname";

/// A lock on a file, released when dropped.
#[derive(Debug)]
pub struct Lock {
    _file: File,
    _claim: Option<Claim>,
}

/// Replaces a lock on file systems without any, such as Lustre without `flock`: a file with the
/// name of the host keeps out other hosts; a socket, which the system frees at the end of the
/// process, keeps out other processes of this host.
#[derive(Debug)]
struct Claim {
    path: PathBuf,
    _socket: UnixListener,
}

impl Lock {
    /// Locks the file at `path` and creates it if it is missing. Fails with [`RunDirError::InUse`]
    /// if another process has the lock, with [`RunDirError::Claimed`] if another host had it.
    pub fn take(path: &Path) -> Result<Self, RunDirError> {
        let file = files::append(path).map_err(io_error("open", path))?;
        let again = |_| {
            sleep(RETRY);
            file.try_lock()
        };
        let claim = match file.try_lock().or_else(again) {
            Ok(()) => None,
            Err(TryLockError::WouldBlock) => return Err(in_use(path)),
            Err(TryLockError::Error(error)) if means_no_locks(&error) => {
                Some(Claim::make(&file, path)?)
            }
            Err(TryLockError::Error(error)) => return Err(io_error("lock", path)(error)),
        };
        Ok(Self { _file: file, _claim: claim })
    }

    /// Takes a shared lock, which excludes [`take`](Self::take). Does nothing on file systems
    /// without locks.
    pub fn share(path: &Path) -> Result<Self, RunDirError> {
        let file = files::append(path).map_err(io_error("open", path))?;
        match file.try_lock_shared() {
            Err(TryLockError::WouldBlock) => Err(in_use(path)),
            _ => Ok(Self { _file: file, _claim: None }),
        }
    }

    /// True if files in a folder can be locked, tried with a temporary file.
    pub fn is_possible(folder: &Path) -> io::Result<bool> {
        let path = folder.join(format!(".lock-{:08x}", rand::random::<u32>()));
        let locked = files::append(&path)?.try_lock();
        fs::remove_file(&path)?;
        match locked {
            Err(TryLockError::Error(error)) if means_no_locks(&error) => Ok(false),
            Err(TryLockError::Error(error)) => Err(error),
            _ => Ok(true),
        }
    }

    /// True if a process has the exclusive lock. On file systems without locks, a process that was
    /// killed may still seem to have it.
    pub fn is_taken(path: &Path) -> bool {
        let Ok(file) = files::open(path) else { return false };
        match file.try_lock_shared() {
            Ok(()) => false,
            Err(TryLockError::WouldBlock) => true,
            Err(TryLockError::Error(_)) => claim_of(path).exists(),
        }
    }
}

impl Claim {
    fn make(file: &File, path: &Path) -> Result<Self, RunDirError> {
        let host = fs::read_to_string(HOST).map_err(io_error("read", Path::new(HOST)))?;
        let socket = || {
            let metadata = file.metadata()?;
            let name = format!("quad lock {} {}", metadata.dev(), metadata.ino());
            UnixListener::bind_addr(&SocketAddr::from_abstract_name(name)?)
        };
        let socket = socket().map_err(|error| match error.kind() {
            ErrorKind::AddrInUse => in_use(path),
            _ => io_error("lock", path)(error),
        })?;
        let path = claim_of(path);
        match File::create_new(&path).and_then(|mut file| file.write_all(host.as_bytes())) {
            Ok(()) => {}
            // A killed process of this host made the file, since the socket was free.
            Err(_) if files::read_text(&path).is_ok_and(|other| other == host) => {}
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                return Err(RunDirError::Claimed(path));
            }
            Err(error) => return Err(io_error("write", &path)(error)),
        }
        Ok(Self { path, _socket: socket })
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        fs::remove_file(&self.path).ok();
    }
}

/// True if the file system has no locks: the system does not know them, or asks a server that does
/// not.
fn means_no_locks(error: &io::Error) -> bool {
    error.kind() == ErrorKind::Unsupported || Errno::from_io_error(error) == Some(Errno::NOLCK)
}

fn in_use(path: &Path) -> RunDirError {
    RunDirError::InUse(path.parent().unwrap_or(path).to_owned())
}

fn claim_of(path: &Path) -> PathBuf {
    path.with_extension("host")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_that_mean_no_locks() {
        let means_none = |error: Errno| means_no_locks(&error.into());
        assert!([Errno::NOSYS, Errno::OPNOTSUPP, Errno::NOLCK].into_iter().all(means_none));
        assert!(![Errno::IO, Errno::INTR, Errno::AGAIN, Errno::ACCESS].into_iter().any(means_none));
    }
}
