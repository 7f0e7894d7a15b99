//! Messages to bytes and back.
//!
//! A frame is the four bytes `QUAD`, the protocol version (u16), the message's kind (u8) and its
//! fields in order of declaration, without padding: integers and floats little-endian at their own
//! width, texts and lists after their length (u64), an enumeration's fields after its variant's
//! index (u32). (It is bincode with fixed-width integers.)
//!
//! The bytes may come from any peer: [`decode`] returns a message that keeps all rules or a typed
//! error. A frame of up to 1 MiB allocates at most 4 MiB at once, a larger one at most 64 MiB.

use std::io::Read;

use bincode::config::{Configuration, Fixint, LittleEndian};
use bincode::error::DecodeError;
use bincode::{Decode, Encode};

use crate::hash::Hash;

/// Version of keys, messages and encoding. Frames of another version are refused.
pub const PROTOCOL_VERSION: u16 = 12;

const MAGIC: &[u8; 4] = b"QUAD";
const HEADER_LENGTH: usize = MAGIC.len() + size_of::<u16>() + size_of::<u8>();

/// Largest frame without a policy: tens of thousands of episodes fit.
const SMALL: usize = 1 << 20;
/// Largest frame with a policy; the paper's networks take a tenth of it.
pub(crate) const LARGE: usize = 64 << 20;
/// Most bytes of memory per byte of a valid small frame: an empty text in a list takes 24 bytes in
/// memory and 8 in the frame.
const MEMORY_PER_WIRE_BYTE: usize = 4;

const FIXED: Configuration<LittleEndian, Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

/// A message.
pub trait Message: Encode + Decode<()> {
    /// Identifies the type of message in a frame.
    const KIND: u8;
    /// Largest frame, bytes.
    const LIMIT: usize = SMALL;

    /// Checks the rules that the encoding alone does not ensure.
    fn verify(&self) -> Result<(), CodecError> {
        Ok(())
    }
}

/// Bytes that are not the expected message, or a message that cannot be sent.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each variant is.
pub enum CodecError {
    #[error("this is no QUAD message")]
    NotQuad,
    #[error(
        "the message has protocol version {theirs}, this program speaks {ours}: update the older of the two"
    )]
    Version { theirs: u16, ours: u16 },
    #[error("the message is of kind {kind}, kind {expected} belongs here")]
    Kind { kind: u8, expected: u8 },
    #[error("the message is cut off")]
    Truncated,
    #[error("the message has {length} bytes, at most {limit} are allowed")]
    Oversized { length: usize, limit: usize },
    #[error("{0} bytes follow the message")]
    Trailing(usize),
    #[error("the message is malformed: {0}")]
    Malformed(String),
    #[error("the file has the hash {actual}, not {claimed} as the message says")]
    Hash { claimed: Hash, actual: Hash },
}

impl CodecError {
    /// The variant, as a metric's label.
    pub fn label(&self) -> &'static str {
        match self {
            CodecError::NotQuad => "not_quad",
            CodecError::Version { .. } => "version",
            CodecError::Kind { .. } => "kind",
            CodecError::Truncated => "truncated",
            CodecError::Oversized { .. } => "oversized",
            CodecError::Trailing(_) => "trailing",
            CodecError::Malformed(_) => "malformed",
            CodecError::Hash { .. } => "hash",
        }
    }
}

/// Encodes a message. Fails with [`CodecError::Oversized`] if every receiver would refuse the frame.
pub fn encode<M: Message>(message: &M) -> Result<Vec<u8>, CodecError> {
    let frame = bincode::encode_to_vec((MAGIC, PROTOCOL_VERSION, M::KIND, message), FIXED)
        .map_err(|error| CodecError::Malformed(error.to_string()))?;
    if frame.len() > M::LIMIT {
        return Err(CodecError::Oversized { length: frame.len(), limit: M::LIMIT });
    }
    Ok(frame)
}

/// Decodes a message and verifies version, kind, length, every field, and a snapshot's hash.
pub fn decode<M: Message>(frame: &[u8]) -> Result<M, CodecError> {
    decode_from(frame.len(), frame)
}

/// [`decode`] of a frame from the disk, which a program of another version may have written: the
/// layout of what is kept never changes, a new one is a new kind of message.
pub fn decode_kept<M: Message>(frame: &[u8]) -> Result<M, CodecError> {
    let begin = [&MAGIC[..], &PROTOCOL_VERSION.to_le_bytes()].concat();
    let rest = frame.get(begin.len()..).unwrap_or_default();
    decode_from(frame.len(), Read::chain(&begin[..], rest))
}

/// [`decode`] of a frame of `length` bytes, which may lie in several pieces.
pub fn decode_from<M: Message>(length: usize, mut frame: impl Read) -> Result<M, CodecError> {
    let mut header = [0; HEADER_LENGTH];
    let read = &mut header[..length.min(HEADER_LENGTH)];
    frame.read_exact(read).map_err(|_| CodecError::Truncated)?;
    if read.len() < HEADER_LENGTH {
        let begins = read.iter().zip(MAGIC).all(|(byte, magic)| byte == magic);
        return Err(if begins { CodecError::Truncated } else { CodecError::NotQuad });
    }
    let [magic @ .., version_low, version_high, kind] = header;
    let version = u16::from_le_bytes([version_low, version_high]);
    if magic != *MAGIC {
        return Err(CodecError::NotQuad);
    }
    if version != PROTOCOL_VERSION {
        return Err(CodecError::Version { theirs: version, ours: PROTOCOL_VERSION });
    }
    if kind != M::KIND {
        return Err(CodecError::Kind { kind, expected: M::KIND });
    }
    if length > M::LIMIT {
        return Err(CodecError::Oversized { length, limit: M::LIMIT });
    }
    let mut body = frame.take((length - HEADER_LENGTH) as u64);
    // Bincode allocates what a length field claims before it reads; the limit bounds that.
    let message: M = if length <= SMALL {
        let limited = FIXED.with_limit::<{ SMALL * MEMORY_PER_WIRE_BYTE }>();
        bincode::decode_from_std_read(&mut body, limited)
    } else {
        bincode::decode_from_std_read(&mut body, FIXED.with_limit::<LARGE>())
    }
    .map_err(body_error)?;
    if body.limit() > 0 {
        return Err(CodecError::Trailing(body.limit() as usize));
    }
    message.verify()?;
    Ok(message)
}

fn body_error(error: DecodeError) -> CodecError {
    match error {
        // The limits exceed what the frame's bytes can hold, so a length field claims too much.
        DecodeError::UnexpectedEnd { .. } | DecodeError::Io { .. } | DecodeError::LimitExceeded => {
            CodecError::Truncated
        }
        DecodeError::OtherString(text) => CodecError::Malformed(text),
        other => CodecError::Malformed(other.to_string()),
    }
}
