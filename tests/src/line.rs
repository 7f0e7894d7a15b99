//! A line: how a program under test reaches the router, and what may go wrong on the way.
//!
//! A [`Link`](crate::link::Link) is one on any machine, for TCP connections. A [`Host`](crate::hosts::Host) is a network
//! of packets, which needs root.

use std::time::Duration;

/// What goes wrong on a line, for a while.
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
    /// The program's machine has no network, and knows it.
    Unplugged,
    /// Everything takes its time.
    Slow,
    /// Some packets are lost.
    Lossy,
}

/// What the chaos test does to a connection, whatever that is made of.
pub trait Line {
    /// What can go wrong on lines of this kind.
    const TROUBLES: &'static [Trouble];

    /// Where a program at its end connects to, as `tcp/host:port`.
    fn endpoint(&self) -> String;

    /// The words that start a program at its end, before the program's own.
    fn launcher(&self) -> Vec<String>;

    /// Lets something go wrong for a while, a little (1 %) or much (100 %). Afterwards the line is whole again.
    fn suffer(&self, trouble: Trouble, percent: u32, a_while: Duration);
}
