//! The secret that comes with a job, and what proves that one has it.

use std::fmt;

use rand::RngCore;

use crate::Hash;
use crate::codec::{Decode, Encode, fields};

/// What only the learner and the evaluator that a job was handed to know. Whoever has it may hand the job back; messages
/// that others may read carry a [`proof`](Self::proof) in its place.
#[derive(Clone, Encode, Decode)]
pub struct Lease([u8; 32]);

impl Lease {
    /// A new one, from a generator that nobody can predict.
    pub fn random() -> Self {
        let mut secret = [0; 32];
        rand::rng().fill_bytes(&mut secret);
        Self(secret)
    }

    /// That the sender of `content` has this lease: a BLAKE3 hash of its encoding under the lease as the key.
    pub(crate) fn proof<M: Encode>(&self, content: &M) -> Hash {
        Hash::keyed(&self.0, &fields(content))
    }
}

/// In a time that says nothing of where they differ.
impl PartialEq for Lease {
    fn eq(&self, other: &Self) -> bool {
        blake3::Hash::from_bytes(self.0) == blake3::Hash::from_bytes(other.0)
    }
}

impl Eq for Lease {}

/// Without the secret, which must not get into a log.
impl fmt::Debug for Lease {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Lease(…)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_proof_is_of_one_lease_and_one_content() {
        let (one, other) = (Lease::random(), Lease::random());
        assert_ne!(one, other);
        assert_eq!(one.proof(&7_u64), one.clone().proof(&7_u64));
        assert_ne!(one.proof(&7_u64), other.proof(&7_u64));
        assert_ne!(one.proof(&7_u64), one.proof(&8_u64));
        assert_eq!(format!("{one:?}"), "Lease(…)");
    }
}
