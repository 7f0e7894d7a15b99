//! Zenoh routers in the test's own process, at ports that the system chooses.

use std::io;
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread;

use quad_runtime::{Endpoints, open_router, reachable_at};
use zenoh::{Config, Session};

/// A router that may come later, end, and come back at the same address.
pub struct Router {
    /// Leads on to the router, if there is one.
    pub endpoint: String,
    address: Arc<Mutex<Option<String>>>,
    session: Option<Session>,
}

impl Router {
    /// The address without a router.
    pub fn later() -> Router {
        let listener = TcpListener::bind("127.0.0.1:0").expect("there is a free port");
        let endpoint = format!("tcp/{}", listener.local_addr().expect("it is bound"));
        let address = Arc::new(Mutex::new(None));
        let shared = address.clone();
        thread::spawn(move || {
            for near in listener.incoming().flatten() {
                let address: Option<String> = shared.lock().expect("no thread panics").clone();
                if let Some(far) = address.and_then(|address| TcpStream::connect(address).ok()) {
                    carry(&near, &far);
                    carry(&far, &near);
                }
            }
        });
        Router { endpoint, address, session: None }
    }

    pub async fn start(&mut self) {
        let (session, endpoint) = open_router().await.expect("the system has a port");
        let address = endpoint.strip_prefix("tcp/").map(str::to_owned);
        *self.address.lock().expect("no thread panics") = address;
        self.session = Some(session);
    }

    pub async fn end(&mut self) {
        *self.address.lock().expect("no thread panics") = None;
        self.session.take().expect("it is there").close().await.expect("it is open");
    }
}

/// Carries bytes one way until either side closes.
fn carry(from: &TcpStream, to: &TcpStream) {
    let (Ok(mut from), Ok(mut to)) = (from.try_clone(), to.try_clone()) else { return };
    thread::spawn(move || {
        io::copy(&mut from, &mut to).ok();
        for stream in [from, to] {
            stream.shutdown(Shutdown::Both).ok();
        }
    });
}

/// A router with deploy/zenoh/router-tls.json5 as it is, but for the address `host` at which it
/// listens, and with its certificate in `certificates`. Gives the endpoint as well.
pub async fn protected_router(host: &str, certificates: &str) -> (Session, String) {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/zenoh/router-tls.json5");
    let mut config = Config::from_file(file).expect("Zenoh understands the configuration");
    let listen = vec![format!("tls/{host}:0")];
    let mut insert = |setting: &str, value: String| {
        config.insert_json5(setting, &value).expect("the setting exists");
    };
    insert("listen/endpoints", format!("{listen:?}"));
    // Makes the session report which port the system has chosen.
    insert("adminspace/enabled", "true".to_owned());
    for (setting, file) in [
        ("root_ca_certificate", "ca.pem"),
        ("listen_certificate", "cert.pem"),
        ("listen_private_key", "key.pem"),
    ] {
        insert(&format!("transport/link/tls/{setting}"), format!("'{certificates}/{file}'"));
    }
    let session = zenoh::open(config).await.expect("the system has a port");
    let endpoints = Endpoints { listen, ..Endpoints::default() };
    let endpoint = reachable_at(&session, &endpoints).await.expect("it listens").remove(0);
    (session, endpoint)
}
