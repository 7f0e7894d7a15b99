//! Names of runs and evaluators.

use std::fmt;

use bincode::de::Decoder;
use bincode::enc::Encoder;
use bincode::error::{DecodeError, EncodeError};
use bincode::{Decode, Encode};
use serde::{Deserialize, Serialize};

/// Name of a run or of an evaluator: 1 to 64 ASCII letters, digits, dots, dashes and underscores,
/// but not `.` or `..`. It needs no quoting in a Zenoh key, a file name or a metric's label.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct Name(String);

/// A text that cannot be a [`Name`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct InvalidName(String);

impl Name {
    /// Most characters of a name.
    pub const MAX_LENGTH: usize = 64;

    /// Checks a name.
    pub fn new(text: impl Into<String>) -> Result<Name, InvalidName> {
        let (text, most) = (text.into(), Self::MAX_LENGTH);
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
        let problem = if let Some(other) = text.chars().find(|&c| !allowed(c)) {
            format!("a name has only letters, digits, '.', '-' and '_', not {other:?}")
        } else if !(1..=most).contains(&text.len()) {
            format!("a name has 1 to {most} characters, not {}", text.len())
        } else if text == "." || text == ".." {
            // As folders, these are the current one and the one above.
            format!("{text:?} is not a name")
        } else {
            return Ok(Name(text));
        };
        Err(InvalidName(problem))
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
    fn names_are_checked() {
        for text in ["a", "hopper-medium-replay-v2", "Run_1.b", "...", &"x".repeat(64)] {
            assert_eq!(Name::new(text).unwrap().as_str(), text);
        }
        for (text, problem) in [
            ("", "a name has 1 to 64 characters, not 0"),
            (&"x".repeat(65), "a name has 1 to 64 characters, not 65"),
            (".", "\".\" is not a name"),
            ("..", "\"..\" is not a name"),
        ] {
            assert_eq!(Name::new(text).unwrap_err().to_string(), problem);
        }
        for character in ['/', '*', '$', ' ', '#', '?', '@', 'é', '\n', '\0'] {
            let error = Name::new(format!("a{character}b")).unwrap_err().to_string();
            assert!(error.ends_with(&format!("not {character:?}")));
        }
    }
}
