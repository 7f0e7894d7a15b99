//! What runs and evaluators may be called.

use std::fmt;

use bincode::de::Decoder;
use bincode::enc::Encoder;
use bincode::error::{DecodeError, EncodeError};
use bincode::{Decode, Encode};
use serde::{Deserialize, Serialize};

/// Name of a run or of an evaluator: 1 to 64 ASCII letters, digits, dots, dashes and underscores,
/// and neither `.` nor `..`.
///
/// It fits into a Zenoh key, a file name and a metric's label without quoting.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct Name(String);

/// Why a text cannot be a [`Name`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct InvalidName(String);

impl Name {
    /// Most characters of a name.
    pub const MAX_LENGTH: usize = 64;

    /// Checks `text` and makes it a name.
    pub fn new(text: impl Into<String>) -> Result<Name, InvalidName> {
        let text = text.into();
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
        if let Some(other) = text.chars().find(|&c| !allowed(c)) {
            return Err(InvalidName(format!(
                "a name has only letters, digits, '.', '-' and '_', not {other:?}"
            )));
        }
        if !(1..=Self::MAX_LENGTH).contains(&text.len()) {
            return Err(InvalidName(format!(
                "a name has 1 to {} characters, not {}",
                Self::MAX_LENGTH,
                text.len()
            )));
        }
        // A folder by this name would be the one that it is in, or the one above.
        if text == "." || text == ".." {
            return Err(InvalidName(format!("{text:?} is not a name")));
        }
        Ok(Name(text))
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for Name {
    type Error = InvalidName;

    fn try_from(text: String) -> Result<Name, InvalidName> {
        Name::new(text)
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl Encode for Name {
    fn encode<E: Encoder>(&self, encoder: &mut E) -> Result<(), EncodeError> {
        self.as_str().encode(encoder)
    }
}

impl<Context> Decode<Context> for Name {
    fn decode<D: Decoder<Context = Context>>(decoder: &mut D) -> Result<Name, DecodeError> {
        Name::new(String::decode(decoder)?)
            .map_err(|error| DecodeError::OtherString(error.to_string()))
    }
}

bincode::impl_borrow_decode!(Name);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_name_may_be() {
        for text in ["a", "hopper-medium-replay-v2", "Run_1.b", "...", &"x".repeat(64)] {
            assert_eq!(Name::new(text).unwrap().as_str(), text);
        }
        let refused = |text: String| Name::new(text).unwrap_err().to_string();
        assert_eq!(refused(String::new()), "a name has 1 to 64 characters, not 0");
        assert_eq!(refused("x".repeat(65)), "a name has 1 to 64 characters, not 65");
        assert_eq!(
            [".", ".."].map(|text| refused(text.to_owned())),
            ["\".\" is not a name", "\"..\" is not a name"]
        );
        for character in ['/', '*', '$', ' ', '#', '?', '@', 'é', '\n', '\0'] {
            assert!(refused(format!("a{character}b")).ends_with(&format!("not {character:?}")));
        }
    }
}
