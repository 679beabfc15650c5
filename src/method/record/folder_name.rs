//! Turns labels (any text) into folder names that every file system accepts.

use std::fmt::Write;

use crate::dataset;
use crate::library::recording::DESCRIPTION;
use crate::seed::stable_hash;
use crate::trial::normal;

/// Longest encoded name, in bytes. File systems allow 255, and a trial's number may follow.
const LONGEST: usize = 160;

/// Whether a folder in a library may have this name: not empty, not hidden, and without `/`.
pub fn is_plain(name: &str) -> bool {
    !name.is_empty() && !name.starts_with('.') && !name.contains(['/', '\0'])
}

/// Whether a name is that of a trial in a library, `SURFACE/TRIAL`.
pub(super) fn is_trial(name: &str) -> bool {
    name.split_once('/').is_some_and(|(surface, trial)| is_plain(surface) && is_plain(trial))
}

/// The folder name of a label. ASCII letters, digits, `_`, `-`, and inner dots and spaces stay.
/// Every other byte becomes `%XX`, and so does the first letter of a reserved name. So no label
/// leads out of its folder, and different labels get different names.
pub(super) fn encode(label: &str) -> String {
    let label = &*normal(label);
    let last = label.len().saturating_sub(1);
    let is_taken = means_something_else(label);
    let mut name = String::with_capacity(label.len());
    for (at, byte) in label.bytes().enumerate() {
        let inner = at != 0 && at != last;
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'_' | b'-' if at > 0 || !is_taken => {
                name.push(char::from(byte));
            }
            b'.' | b' ' if inner => name.push(char::from(byte)),
            // Writing to a string cannot fail.
            _ => write!(name, "%{byte:02X}").unwrap_or_default(),
        }
    }
    if name.len() > LONGEST {
        // The cut is safe: the name is ASCII. The hash distinguishes labels that begin alike.
        name.truncate(LONGEST - 17);
        let hash = stable_hash(&[label.as_bytes()]);
        write!(name, "~{hash:016x}").unwrap_or_default();
    }
    name
}

/// Whether a label can be used as a folder's name without any change.
pub(super) fn is_usable(label: &str) -> bool {
    let is_name = is_plain(label) && !label.contains('\\') && label.len() <= LONGEST;
    is_name && !means_something_else(label)
}

/// Whether a name is reserved: by the library's format, or for a device on Windows, where a copy may go.
fn means_something_else(label: &str) -> bool {
    let lower = label.to_ascii_lowercase();
    let stem = lower.split('.').next().unwrap_or_default();
    let port = stem.strip_prefix("com").or(stem.strip_prefix("lpt"));
    let is_device = matches!(stem, "con" | "prn" | "aux" | "nul")
        || port.is_some_and(|n| n.len() == 1 && n.bytes().all(|byte| byte.is_ascii_digit()));
    is_device || lower == DESCRIPTION || dataset::is_layout_name(label)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn names_that_mean_something_else_or_lead_elsewhere_are_escaped_and_others_stay() {
        for (label, name) in [
            ("oak, sanded v1.2", "oak%2C sanded v1.2"),
            ("library.toml", "%6Cibrary.toml"),
            ("../x", "%2E.%2Fx"),
            ("..", "%2E%2E"),
            (".", "%2E"),
            ("/etc", "%2Fetc"),
            ("a\\b\0", "a%5Cb%00"),
        ] {
            assert_eq!(encode(label), name);
        }
        for label in ["SoundScans", "accelscanscomponents", "DataLMT108", "Con", "nul.oak", "COM1"]
        {
            assert!(encode(label).starts_with('%'), "{label}");
        }
        for label in ["G1EpoxyRasterPlate", "console", "com", "com10", "sounds", "oak.library.toml"]
        {
            assert_eq!(encode(label), label);
        }
    }

    proptest! {
        #[test]
        fn a_name_is_one_plain_component(label in "\\PC{1,300}|[./ ]{1,5}|.{1,9}") {
            let name = encode(&label);
            prop_assert!(!name.is_empty() && name.len() <= LONGEST);
            prop_assert!(!name.starts_with('.') && !name.contains(['/', '\\', '\0']));
        }

        #[test]
        fn different_labels_have_different_names(a in "[./% a]{1,4}", b in "[./% a]{1,4}") {
            prop_assert_eq!(a == b, encode(&a) == encode(&b));
        }
    }
}
