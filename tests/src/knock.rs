//! Somebody who opens connections and says nothing.

use std::collections::VecDeque;
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

/// How long to wait for a connection before the next one is tried.
const PATIENCE: Duration = Duration::from_millis(20);

/// Opens connections to `address` as fast as it goes, for as long as it is `on`, and leaves the newest hundred open.
pub fn knock(address: &SocketAddr, on: &AtomicBool) {
    let mut open = VecDeque::new();
    while on.load(Relaxed) {
        open.extend(TcpStream::connect_timeout(address, PATIENCE));
        if open.len() > 100 {
            open.pop_front();
        }
    }
}
