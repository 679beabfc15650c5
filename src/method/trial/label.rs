//! Labels, the names of surfaces and users, and the characters that they may hold.

const LONGEST: usize = 80;
/// The characters that a label may contain besides letters, digits and spaces.
const MARKS: &str = "_-.,()+'%#";

/// A label in Unicode's normal form C, so that an é is the same however it was typed.
pub fn normal(label: &str) -> String {
    use unicode_normalization::UnicodeNormalization;
    label.nfc().collect()
}

/// Returns a label in normal form, without outer spaces. Refuses labels that are unsafe in file names,
/// pages or terminals; the message continues a sentence that begins with the field.
pub fn checked_label(label: &str) -> Result<String, String> {
    checked(label, MARKS)
}

/// Like [`checked_label`], for the name of a session. It may be a moment, such as `2026-11-25T10:42`,
/// since no file is named after it.
pub fn checked_session(name: &str) -> Result<String, String> {
    checked(name, &format!("{MARKS}:"))
}

fn checked(label: &str, marks: &str) -> Result<String, String> {
    let label = normal(label.trim());
    let odd = label.chars().find(|&c| !(c.is_alphanumeric() || c == ' ' || marks.contains(c)));
    if label.is_empty() {
        Err("is empty; give it a name, such as \"oak\"".into())
    } else if label.chars().count() > LONGEST {
        Err(format!("is longer than {LONGEST} characters"))
    } else if label.starts_with('.') {
        Err("begins with a dot; begin it with a letter or digit".into())
    } else if let Some(odd) = odd {
        let marks = marks.chars().map(String::from).collect::<Vec<_>>().join(" ");
        Err(format!("holds {odd:?}; use letters, digits, spaces and {marks}"))
    } else {
        Ok(label)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn common_labels_are_taken_and_trimmed() {
        for name in ["oak", "G1EpoxyRasterPlate", "Eiche, geölt (2)", "木 100%", " oak "] {
            assert_eq!(checked_label(name).unwrap(), name.trim());
        }
        assert_eq!(checked_label("e\u{301}rable").unwrap(), "\u{e9}rable");
    }

    #[test]
    fn what_could_mean_something_to_a_file_system_a_page_or_a_terminal_is_refused() {
        let long = "x".repeat(LONGEST + 1);
        for name in [
            "", "  ", "../etc", ".", "a/b", "a\\b", "a\0b", "<script>", "a&b", "\x1b[2J", "a\nb",
            &long,
        ] {
            assert!(checked_label(name).is_err(), "{name:?}");
        }
    }
}
