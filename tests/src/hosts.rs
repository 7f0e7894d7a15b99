//! Hosts on one machine: network namespaces on a private bridge, whose packets can be lost or held up.
//!
//! Needs root, `ip`, `tc` and `nft`. The bridge has an address on this machine, so that a
//! router in the test's own process can be reached; what happens to packets happens outside the hosts, unseen by them.

use std::fs;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process::Command;
use std::thread::sleep;
use std::time::Duration;

use crate::line::{Line, Trouble};

/// The network's range, of which each test process takes sixteen addresses: 198.18.0.0/15 is set aside for tests.
const RANGE: u32 = 0xC612_0000;
const RANGE_SIZE: u32 = 1 << 17;
const PREFIX: &str = "quad-";

/// A bridge with hosts. All of it goes when dropped.
pub struct Network {
    /// Name of the bridge: unique on this machine.
    name: String,
    /// Address of this machine on the bridge.
    pub address: String,
}

/// A host on it, and the line from there to this machine.
pub struct Host {
    /// Name of the namespace, and of the outer end of the cable whose inner end is the host's eth0.
    name: String,
    endpoint: String,
}

impl Network {
    /// A bridge without hosts, or why there can be none here.
    pub fn new() -> Result<Network, String> {
        let process = std::process::id();
        // Also what an earlier process of the same number may have left.
        remove(|owner| owner == process || !Path::new(&format!("/proc/{owner}")).exists());
        let network = Network { name: format!("{PREFIX}{process}"), address: address(1) };
        let Network { name, address } = &network;
        run(&format!("ip link add {name} type bridge"))?;
        run(&format!("ip addr add {address}/28 dev {name}"))?;
        run(&format!("ip link set {name} up"))?;
        Ok(network)
    }

    /// Adds a host, the `number`th from 1, whose line leads to a port of this machine.
    pub fn host(&self, number: u32, port: u16) -> Result<Host, String> {
        let (name, address) = (format!("{}-{number}", self.name), address(1 + number));
        run(&format!("ip netns add {name}"))?;
        run(&format!("ip link add {name} type veth peer name eth0 netns {name}"))?;
        run(&format!("ip link set {name} master {} up", self.name))?;
        run(&format!("ip -n {name} addr add {address}/28 dev eth0"))?;
        run(&format!("ip -n {name} link set lo up"))?;
        run(&format!("ip -n {name} link set eth0 up"))?;
        Ok(Host { name, endpoint: format!("tcp/{}:{port}", self.address) })
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        let process = std::process::id();
        remove(|owner| owner == process);
    }
}

impl Line for Host {
    const TROUBLES: &'static [Trouble] =
        &[Trouble::Silent, Trouble::Deaf, Trouble::Mute, Trouble::Unplugged, Trouble::Slow, Trouble::Lossy];

    fn endpoint(&self) -> String {
        self.endpoint.clone()
    }

    // It becomes the program, so that a signal reaches the program itself.
    fn launcher(&self) -> Vec<String> {
        ["ip", "netns", "exec", &self.name].map(str::to_owned).to_vec()
    }

    fn suffer(&self, trouble: Trouble, percent: u32, a_while: Duration) {
        let name = &self.name;
        let (from, to) = (("prerouting", "iifname"), ("postrouting", "oifname"));
        let (begin, end) = match trouble {
            Trouble::Silent => self.drop_packets(&[from, to], ""),
            Trouble::Deaf => self.drop_packets(&[to], ""),
            Trouble::Mute => self.drop_packets(&[from], ""),
            Trouble::Lossy => self.drop_packets(&[from, to], &format!("numgen random mod 200 < {percent}")),
            Trouble::Slow => {
                let rate = 5000 / percent;
                let limit = format!("tbf rate {rate}kbit burst 5kb limit 30kb");
                let begin = self.at_both_ends(|device| format!("tc qdisc add dev {device} root {limit}"));
                (begin, self.at_both_ends(|device| format!("tc qdisc del dev {device} root")))
            }
            Trouble::Unplugged => {
                let set = |state: &str| vec![format!("ip -n {name} link set eth0 {state}")];
                (set("down"), set("up"))
            }
            Trouble::Cut => unreachable!("not among the troubles of hosts"),
        };
        begin.iter().for_each(|command| run(command).unwrap());
        sleep(a_while);
        end.iter().for_each(|command| run(command).unwrap());
    }
}

impl Host {
    /// Commands that let the bridge drop those packets of this host that fulfil a condition, and those that undo it.
    fn drop_packets(&self, directions: &[(&str, &str)], condition: &str) -> (Vec<String>, Vec<String>) {
        let name = &self.name;
        let chain = |&(hook, of): &(&str, &str)| {
            format!("chain {hook} {{ type filter hook {hook} priority 0 ; {of} {name} {condition} drop ; }} ;")
        };
        let chains: Vec<_> = directions.iter().map(chain).collect();
        let begin = format!("nft table bridge {name} {{ {} }}", chains.join(" "));
        (vec![begin], vec![format!("nft delete table bridge {name}")])
    }

    /// A command about what leaves through a device, at the outer end of the cable and at the inner one.
    fn at_both_ends(&self, command: impl Fn(&str) -> String) -> Vec<String> {
        let inside = format!("ip netns exec {} {}", self.name, command("eth0"));
        vec![command(&self.name), inside]
    }
}

/// The `number`th address of this process's sixteen.
fn address(number: u32) -> String {
    Ipv4Addr::from_bits(RANGE + (std::process::id() * 16) % RANGE_SIZE + number).to_string()
}

/// Removes the networks of those test processes, as far as they are there.
fn remove(of: impl Fn(u32) -> bool) {
    for folder in ["/run/netns", "/sys/class/net"] {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            let owner = name.strip_prefix(PREFIX).and_then(|rest| rest.split('-').next()?.parse().ok());
            if owner.is_some_and(&of) {
                for command in ["ip netns del", "ip link del", "nft delete table bridge"] {
                    run(&format!("{command} {name}")).ok();
                }
            }
        }
    }
}

fn run(command: &str) -> Result<(), String> {
    let mut words = command.split_whitespace();
    let output = Command::new(words.next().unwrap_or_default()).args(words).output();
    let output = output.map_err(|error| format!("{command}: {error}"))?;
    match output.status.success() {
        true => Ok(()),
        false => Err(format!("{command}: {}", String::from_utf8_lossy(&output.stderr).trim())),
    }
}
