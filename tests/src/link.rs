//! A network connection that a test can cut, freeze and slow down: it leads a program on to a port
//! of this machine.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

/// Interval at which an idle connection is checked.
const GLANCE: Duration = Duration::from_millis(20);

/// Fault of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Trouble {
    /// Connections end, and new ones are turned away.
    Cut,
    /// Nothing goes through, and neither end is told.
    Silent,
    /// Nothing reaches the program; what it sends arrives.
    Deaf,
    /// Nothing that the program sends arrives; what others send reaches it.
    Mute,
    Slow,
}

impl Trouble {
    pub const ALL: [Self; 5] = [Self::Cut, Self::Silent, Self::Deaf, Self::Mute, Self::Slow];
}

/// Leads every connection to its address on to a port of this machine.
pub struct Link {
    /// Address for the program, as `tcp/host:port`.
    pub endpoint: String,
    state: Arc<State>,
}

#[derive(Default)]
struct State {
    cut: AtomicBool,
    /// The directions from and to the program.
    frozen: [AtomicBool; 2],
    delay_milliseconds: AtomicU64,
    streams: Mutex<Vec<TcpStream>>,
}

impl Link {
    /// Makes a link to a port that may be opened now or later.
    pub fn to(port: u16) -> Link {
        let listener = TcpListener::bind("127.0.0.1:0").expect("there is a free port");
        let endpoint = format!("tcp/{}", listener.local_addr().expect("it is bound"));
        let state = Arc::new(State::default());
        let shared = state.clone();
        thread::spawn(move || {
            for near in listener.incoming().flatten() {
                if shared.cut.load(Relaxed) {
                    continue;
                }
                // If the port is closed, the connection ends at once.
                let Ok(far) = TcpStream::connect(("127.0.0.1", port)) else { continue };
                let streams = || Some([near.try_clone().ok()?, far.try_clone().ok()?]);
                let Some(copies) = streams() else { continue };
                let mut open = shared.streams.lock().expect("no thread panics with it");
                open.retain(|stream| stream.peer_addr().is_ok());
                open.extend(copies);
                for (way, (from, to)) in [(&near, &far), (&far, &near)].into_iter().enumerate() {
                    let (Ok(from), Ok(to)) = (from.try_clone(), to.try_clone()) else { continue };
                    let state = shared.clone();
                    thread::spawn(move || carry(from, to, way, &state));
                }
            }
        });
        Link { endpoint, state }
    }

    /// Lets something go wrong for a while, a little (1 %) or much (100 %). Afterwards the
    /// connection is whole again.
    pub fn suffer(&self, trouble: Trouble, percent: u32, a_while: Duration) {
        let state = &self.state;
        match trouble {
            Trouble::Cut => {
                state.cut.store(true, Relaxed);
                for stream in state.streams.lock().expect("no thread panics with it").drain(..) {
                    stream.shutdown(Shutdown::Both).ok();
                }
            }
            Trouble::Silent => state.frozen.iter().for_each(|way| way.store(true, Relaxed)),
            Trouble::Mute => state.frozen[0].store(true, Relaxed),
            Trouble::Deaf => state.frozen[1].store(true, Relaxed),
            Trouble::Slow => state.delay_milliseconds.store(u64::from(percent) * 7 / 2, Relaxed),
        }
        thread::sleep(a_while);
        state.cut.store(false, Relaxed);
        state.frozen.iter().for_each(|way| way.store(false, Relaxed));
        state.delay_milliseconds.store(0, Relaxed);
    }
}

fn carry(mut from: TcpStream, mut to: TcpStream, way: usize, state: &State) {
    from.set_read_timeout(Some(GLANCE)).ok();
    let mut block = [0; 1 << 16];
    loop {
        match from.read(&mut block) {
            Ok(0) => break,
            Ok(length) => {
                thread::sleep(Duration::from_millis(state.delay_milliseconds.load(Relaxed)));
                while state.frozen[way].load(Relaxed) {
                    thread::sleep(GLANCE);
                }
                if to.write_all(&block[..length]).is_err() {
                    break;
                }
            }
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(_) => break,
        }
    }
    from.shutdown(Shutdown::Both).ok();
    to.shutdown(Shutdown::Both).ok();
}
