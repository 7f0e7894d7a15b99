//! The firewall in front of the router: whoever opens connections as fast as he can is kept out, others are not, and that stays
//! so when the router is started again.

use quad_tests::eventually;

use crate::compose::{Compose, PATIENCE, docker, inspect, succeeds};

/// What an address may open at once, by deploy/zenoh/firewall.nft, and what comes on top in the seconds that this takes.
const AT_ONCE: usize = 800;
const LATER: usize = 100;
/// Connects as fast as it goes for five seconds, and says how often that worked.
const KNOCK: &str = "address=$(getent hosts router); address=${address%% *}; \
                     timeout 5 bash -c \"while exec 3<>/dev/tcp/$address/7447; do echo; done\" | wc -l";
/// The same once.
const CONNECT: &str = "timeout 5 bash -c 'exec 3<>/dev/tcp/router/7447'";

#[test]
#[ignore = "builds the images: cargo test --release --workspace --test docker -- --ignored"]
fn compose_keeps_out_who_opens_connections_as_fast_as_he_can() {
    let Some(compose) = Compose::project("firewall", "") else { return };
    compose.run(&["up", "--detach", "router", "firewall"]);
    let network = compose.network();
    let stranger = ["run", "--rm", "--network", &network, "--entrypoint", "bash", "quad/firewall", "-c"];
    for round in ["first", "after a restart"] {
        let firewall = compose.container("firewall");
        eventually("the rules are there", PATIENCE, || {
            let healthy = inspect(&firewall, "{{.State.Health.Status}}") == "healthy";
            (healthy && is_in(&compose.container("router"), &firewall)).then_some(())
        });
        let opened: usize = docker(&[&stranger[..], &[KNOCK]].concat()).trim().parse().expect("a number");
        eprintln!("{round}: {opened} connections in 5 s");
        assert!((AT_ONCE..AT_ONCE + LATER).contains(&opened), "{round}: {opened} connections");
        assert!(
            succeeds(&[&stranger[..], &[CONNECT]].concat()),
            "{round}: a newcomer from another address is kept out"
        );
        docker(&["restart", "--timeout", "2", &compose.container("router")]);
    }
}

/// Whether the firewall has started after the router, whose network it shares.
fn is_in(router: &str, firewall: &str) -> bool {
    inspect(router, "{{.State.StartedAt}}") < inspect(firewall, "{{.State.StartedAt}}")
}
