//! Somebody who speaks Zenoh's own protocol, byte by byte, and sends messages in pieces as no Zenoh session would.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use rand::random;

/// Zenoh's `zenoh_protocol::transport::id` and flags. A reliable piece, after which more follow.
const INIT: u8 = 0x01;
const OPEN: u8 = 0x02;
const CLOSE: u8 = 0x03;
const PIECE: u8 = 0x06 | RELIABLE;
const RELIABLE: u8 = 1 << 5;
const MORE: u8 = 1 << 6;
const SIZES: u8 = 1 << 6;
const SECONDS: u8 = 1 << 6;
const VERSION: u8 = 0x09;
const CLIENT: u8 = 0b10;
/// How long anything is waited for.
const PATIENCE: Duration = Duration::from_secs(20);

/// A connection that was accepted.
#[derive(Debug)]
pub struct Pieces {
    stream: TcpStream,
    sequence: u64,
}

impl Pieces {
    /// Connects as a client whose batches may be as large as Zenoh's may.
    pub fn connect(endpoint: &str) -> Pieces {
        let stream = TcpStream::connect(endpoint.trim_start_matches("tcp/")).expect("somebody listens");
        stream.set_nodelay(true).expect("a TCP connection");
        stream.set_read_timeout(Some(PATIENCE)).expect("a TCP connection");
        let mut pieces = Pieces { stream, sequence: 1 };
        // An identity may not end with a zero.
        let identity = (random::<u64>() | 1 << 63).to_le_bytes();
        pieces.send(&[&[INIT, VERSION, CLIENT | 7 << 4], &identity[..]].concat());
        let answer = pieces.receive();
        assert_eq!(answer[0] & 0x1f, INIT, "{answer:?}");
        // After the sizes, if they are there, comes a cookie to give back.
        let identity = 1 + usize::from(answer[2] >> 4);
        let cookie = &answer[3 + identity + if answer[0] & SIZES == 0 { 0 } else { 3 }..];
        let (length, cookie) = read_number(cookie);
        let mut open = vec![OPEN | SECONDS];
        [10, 1, length].iter().for_each(|&number| write_number(number, &mut open));
        open.extend(&cookie[..length as usize]);
        pieces.send(&open);
        let answer = pieces.receive();
        assert_eq!(answer[0] & 0x1f, OPEN, "{answer:?}");
        pieces
    }

    /// Sends the next piece of a message.
    pub fn piece(&mut self, piece: &[u8], last: bool) {
        let mut batch = vec![if last { PIECE } else { PIECE | MORE }];
        write_number(self.sequence, &mut batch);
        self.sequence += 1;
        batch.extend(piece);
        self.send(&batch);
    }

    /// Leaves, and waits until all that was sent has been read.
    pub fn leave(mut self) {
        self.send(&[CLOSE | 1 << 5, 0]);
        loop {
            match self.stream.read(&mut [0; 1000]) {
                Ok(0) => return,
                Err(error) if error.kind() == ErrorKind::ConnectionReset => return,
                Ok(_) => {}
                Err(error) => panic!("the connection stays open: {error}"),
            }
        }
    }

    fn send(&mut self, batch: &[u8]) {
        let length = u16::try_from(batch.len()).expect("it fits into a batch").to_le_bytes();
        self.stream.write_all(&[&length, batch].concat()).expect("the connection is open");
    }

    fn receive(&mut self) -> Vec<u8> {
        let mut length = [0; 2];
        self.stream.read_exact(&mut length).expect("an answer");
        let mut batch = vec![0; u16::from_le_bytes(length).into()];
        self.stream.read_exact(&mut batch).expect("an answer");
        batch
    }
}

/// A whole message of Zenoh's: somebody publishes `payload`.
pub fn publication(key: &str, payload: &[u8]) -> Vec<u8> {
    const PUSH: u8 = 0x1d | 1 << 5 | 1 << 6;
    const PUT: u8 = 0x01;
    let mut message = vec![PUSH, 0];
    write_number(key.len() as u64, &mut message);
    message.extend(key.bytes());
    message.push(PUT);
    write_number(payload.len() as u64, &mut message);
    message.extend(payload);
    message
}

/// Seven bits in a byte, the lowest first; the eighth says that more follow.
fn write_number(mut number: u64, to: &mut Vec<u8>) {
    while number > 0x7f {
        to.push(number as u8 | 0x80);
        number >>= 7;
    }
    to.push(number as u8);
}

fn read_number(bytes: &[u8]) -> (u64, &[u8]) {
    let length = 1 + bytes.iter().take_while(|&&byte| byte & 0x80 != 0).count();
    let number = bytes[..length].iter().rev().fold(0, |number, byte| number << 7 | u64::from(byte & 0x7f));
    (number, &bytes[length..])
}
