//! deploy/zenoh/firewall.nft: whoever opens connections as fast as he can is kept out, and nobody else is.
//!
//! With all tests it takes some seconds. What docs/reliability.md says of it comes from
//! `QUAD_SECONDS=3 QUAD_ROUNDS=5 cargo test --release --workspace --test firewall -- --nocapture`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread;
use std::time::{Duration, Instant};

use quad_protocol::Name;
use quad_tests::crowd::{Crowd, Pace};
use quad_tests::hosts::Network;
use quad_tests::knock::knock;
use quad_tests::line::Line;
use quad_tests::pace::{ENDLESS, compare, on_core};
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, number};
use tokio::runtime::Runtime;

/// The port that the rules are about.
const PORT: u16 = 7447;
/// In so long he has used up what he may open at once.
const USED_UP: Duration = Duration::from_secs(2);

/// Knocks until it is dropped.
struct Stranger(Arc<AtomicBool>);

impl Stranger {
    fn start(address: &str) -> Stranger {
        let (on, address) = (Arc::new(AtomicBool::new(true)), address.parse().unwrap());
        let knocking = on.clone();
        thread::spawn(move || knock(&address, &knocking));
        Stranger(on)
    }
}

impl Drop for Stranger {
    fn drop(&mut self) {
        self.0.store(false, Relaxed);
    }
}

#[test]
fn who_opens_connections_as_fast_as_he_can_is_kept_out_and_others_are_not() {
    let network = match Network::new() {
        Ok(network) => network,
        Err(reason) => return eprintln!("skipped, because there can be no network of hosts here: {reason}"),
    };
    let home = network.host(1, PORT).unwrap();
    let rules = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/zenoh/firewall.nft");
    home.run(&format!("nft -f {rules}")).unwrap();
    let (phase, rounds) = (Duration::from_secs(number("QUAD_SECONDS", 1)), number("QUAD_ROUNDS", 3) as usize);
    let (scratch, metrics) = (Scratch::new(), format!("{}:0", home.address));
    let arguments = ["--listen", &format!("tcp/0.0.0.0:{PORT}"), "--metrics", &metrics];
    let learner = on_core(1, || scratch.learner_through(&home.launcher(), "run", ENDLESS, &arguments));
    on_core(0, || {
        let endpoint = format!("tcp/{}:{PORT}", home.address);
        // The stranger has an address of his own.
        let address = format!("{}:{PORT}", network.other_address(&home).unwrap());
        learner.process.wait_for_log("no evaluator", PATIENCE);
        let runtime = Runtime::new().unwrap();
        let crowd = runtime.block_on(Crowd::connect(5, &Name::new("run").unwrap(), &endpoint));
        crowd.set(Pace::Real);
        let stranger = Stranger::start(&address);
        thread::sleep(USED_UP);
        drop(stranger);
        crowd.measured();
        let mut stranger = None;
        let [quiet, loud] = compare(&learner, rounds, phase, |loud| stranger = loud.then(|| Stranger::start(&address)));
        let claims = crowd.measured().claims;
        let (taken, share) = (loud.other_threads - quiet.other_threads, loud.steps_per_second / quiet.steps_per_second);
        let slowest = claims.iter().max().expect("evaluators are served");
        eprintln!("connections: training at {share:.3}, {taken:.3} s/s besides, slowest claim {slowest:.1?}");
        assert!(taken < 0.02, "he takes {taken:.3} s of processor time a second");

        let _stranger = Stranger::start(&address);
        let begin = Instant::now();
        scratch.evaluator("newcomer", &endpoint).process.wait_for_log("found a run", PATIENCE);
        eprintln!("a newcomer from another address found the run in {:.1?}", begin.elapsed());
    });
}
