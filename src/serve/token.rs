//! The secret of a server that other machines can reach.

use std::fmt;

use subtle::ConstantTimeEq;

use super::error::ServeError;

/// What a client must know. Compared in constant time, and never printed.
#[derive(Clone)]
pub struct Token(String);

impl Token {
    /// A token from its text.
    ///
    /// # Errors
    /// If it is shorter than 16 characters or longer than 256, or would need quoting in a header,
    /// a cookie or an address.
    pub fn new(text: &str) -> Result<Self, ServeError> {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-._~".contains(c);
        if !(16..=256).contains(&text.len()) || !text.chars().all(plain) {
            return Err(ServeError::Token);
        }
        Ok(Self(text.into()))
    }

    /// Whether a client knows it. The time that this takes depends on the length alone.
    pub fn matches(&self, given: &str) -> bool {
        self.0.as_bytes().ct_eq(given.as_bytes()).into()
    }

    /// The text, for the cookie.
    pub(super) fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_whole_token_matches() {
        let token = Token::new("0123456789abcdef").unwrap();
        assert!(token.matches("0123456789abcdef"));
        for wrong in ["", "0123456789abcde", "0123456789abcdef0", "0123456789abcdeF"] {
            assert!(!token.matches(wrong), "{wrong}");
        }
        assert_eq!(format!("{token:?}"), "Token(…)");
    }

    #[test]
    fn a_token_that_is_short_or_would_need_quoting_is_refused() {
        for text in ["", "short", "0123456789abcde;", "0123456789 abcdef", &"x".repeat(257)] {
            assert!(Token::new(text).is_err(), "{text}");
        }
    }
}
