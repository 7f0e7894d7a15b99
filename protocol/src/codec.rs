//! Messages to bytes and back. Each message says beside its fields which kind of frame it is.
//!
//! A frame is the four bytes `QUAD`, the protocol version (u16), the message's kind (u8) and its
//! fields in order of declaration, without padding: integers and floats little-endian at their own
//! width, texts and lists with their length (u64) before them, an enumeration with its variant's
//! index (u32) before its fields. (It is bincode with fixed-width integers.)
//!
//! The bytes may come from any peer. Whatever they are, [`decode`] gives a message that keeps all
//! rules or a typed error. A frame of up to 1 MiB never makes it allocate more than 4 MiB at once,
//! a larger one never more than 64 MiB.

use std::io::Read;

use bincode::config::{Configuration, Fixint, LittleEndian};
use bincode::error::DecodeError;

use bincode::{Decode, Encode};

use crate::hash::Hash;

/// Version of keys, messages and encoding. Frames of another version are refused.
pub const PROTOCOL_VERSION: u16 = 8;

const MAGIC: &[u8; 4] = b"QUAD";
const HEADER_LENGTH: usize = MAGIC.len() + size_of::<u16>() + size_of::<u8>();

/// Largest frame without a policy: tens of thousands of episodes fit.
const SMALL: usize = 1 << 20;
/// Largest frame with a policy; the paper's networks take a tenth of it.
pub(crate) const LARGE: usize = 64 << 20;
/// Most bytes of memory per byte of a valid small frame: an empty text in a list takes 24 bytes, 8
/// of them in the frame.
const MEMORY_PER_WIRE_BYTE: usize = 4;

const FIXED: Configuration<LittleEndian, Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

/// A message: each type has a kind of frame of its own.
pub trait Message: Encode + Decode<()> {
    /// Identifies the message within a frame.
    const KIND: u8;
    /// Largest frame, bytes.
    const LIMIT: usize = SMALL;

    /// Checks the rules that the encoding alone does not ensure.
    fn verify(&self) -> Result<(), CodecError> {
        Ok(())
    }
}

/// Why bytes are not the expected message, or a message cannot be sent.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs)] // The sentences say what each is.
pub enum CodecError {
    #[error("this is no QUAD message")]
    NotQuad,
    #[error(
        "the message has protocol version {theirs}, this program speaks {ours}: update the older of the two"
    )]
    Version { theirs: u16, ours: u16 },
    #[error("the message is of kind {found}, kind {expected} belongs here")]
    Kind { found: u8, expected: u8 },
    #[error("the message is cut off")]
    Truncated,
    #[error("the message has {length} bytes, at most {limit} are allowed")]
    Oversized { length: usize, limit: usize },
    #[error("{0} bytes follow the message")]
    Trailing(usize),
    #[error("the message is malformed: {0}")]
    Malformed(String),
    #[error("the file has the hash {found}, not {claimed} as the message says")]
    Hash { claimed: Hash, found: Hash },
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

/// The frame of `message`.
///
/// # Errors
///
/// [`CodecError::Oversized`]: every receiver would refuse the frame.
pub fn encode<M: Message>(message: &M) -> Result<Vec<u8>, CodecError> {
    let frame = bincode::encode_to_vec((MAGIC, PROTOCOL_VERSION, M::KIND, message), FIXED)
        .map_err(|error| CodecError::Malformed(error.to_string()))?;
    if frame.len() > M::LIMIT {
        return Err(CodecError::Oversized { length: frame.len(), limit: M::LIMIT });
    }
    Ok(frame)
}

/// The message in `frame`, verified: its version, kind, length, every field, and a snapshot's hash.
///
/// # Errors
///
/// Any [`CodecError`], the first that is found.
pub fn decode<M: Message>(frame: &[u8]) -> Result<M, CodecError> {
    decode_from(frame.len(), frame)
}

/// [`decode`] of a frame of `length` bytes that are read one after the other. It saves a copy of
/// those that did not come in one piece.
///
/// # Errors
///
/// Any [`CodecError`], the first that is found.
pub fn decode_from<M: Message>(length: usize, mut frame: impl Read) -> Result<M, CodecError> {
    let mut header = [0; HEADER_LENGTH];
    let read = &mut header[..length.min(HEADER_LENGTH)];
    frame.read_exact(read).map_err(|_| CodecError::Truncated)?;
    if read.len() < HEADER_LENGTH {
        let begins = read.iter().zip(MAGIC).all(|(found, expected)| found == expected);
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
        return Err(CodecError::Kind { found: kind, expected: M::KIND });
    }
    if length > M::LIMIT {
        return Err(CodecError::Oversized { length, limit: M::LIMIT });
    }
    let mut body = frame.take((length - HEADER_LENGTH) as u64);
    // Bincode allocates what a length field claims before it reads; the limit bounds that.
    let message: M = if length <= SMALL {
        bincode::decode_from_std_read(
            &mut body,
            FIXED.with_limit::<{ SMALL * MEMORY_PER_WIRE_BYTE }>(),
        )
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
        // The limits are never below what the frame's own bytes can hold, so more was claimed than
        // there is.
        DecodeError::UnexpectedEnd { .. } | DecodeError::Io { .. } | DecodeError::LimitExceeded => {
            CodecError::Truncated
        }
        DecodeError::OtherString(text) => CodecError::Malformed(text),
        other => CodecError::Malformed(other.to_string()),
    }
}
