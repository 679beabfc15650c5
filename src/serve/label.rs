//! Checks labels from the network: valid ones are harmless in file names, pages and terminals.

use crate::trial::normal;

/// Longest label in characters.
const LONGEST: usize = 80;
/// The characters that a label may hold beside letters, digits and spaces.
const MARKS: &str = "_-.,()+'%#";

/// The label of a surface or a user in normal form, without spaces around it.
///
/// # Errors
/// If it is not valid, with the reason. `what` names the field.
pub(super) fn check(what: &str, label: &str) -> Result<String, String> {
    let label = &*normal(label.trim());
    if label.is_empty() {
        return Err(format!("`{what}` is empty; give it a name, such as \"oak\""));
    }
    if label.chars().count() > LONGEST {
        return Err(format!("`{what}` is longer than {LONGEST} characters"));
    }
    if label.starts_with('.') {
        return Err(format!("`{what}` begins with a dot; begin it with a letter or digit"));
    }
    match label.chars().find(|&c| !(c.is_alphanumeric() || c == ' ' || MARKS.contains(c))) {
        None => Ok(label.into()),
        Some(odd) => Err(format!(
            "`{what}` holds {odd:?}; use letters, digits, spaces and {}",
            MARKS.chars().map(String::from).collect::<Vec<_>>().join(" ")
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn common_labels_are_taken_and_trimmed() {
        for label in ["oak", "G1EpoxyRasterPlate", "Eiche, geölt (2)", "木 100%", " oak "] {
            assert_eq!(check("surface", label).as_deref(), Ok(label.trim()));
        }
        assert_eq!(check("surface", "e\u{301}rable").as_deref(), Ok("\u{e9}rable"));
    }

    #[test]
    fn what_could_mean_something_to_a_file_system_a_page_or_a_terminal_is_refused() {
        for label in
            ["", "  ", "../etc", ".", "a/b", "a\\b", "a\0b", "<script>", "a&b", "\u{1b}[2J", "a\nb"]
        {
            assert!(check("surface", label).unwrap_err().contains("`surface`"), "{label:?}");
        }
        assert!(check("user", &"x".repeat(81)).is_err());
    }
}
