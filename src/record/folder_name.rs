//! Folder names that any file system takes, for labels that may hold anything.

use std::fmt::Write;

use crate::seed::stable_hash;

/// Longest name in bytes; file systems allow 255, and the trial's number follows.
const LONGEST: usize = 160;

/// A folder name for a label: letters, digits, `.`, `_`, `-` and inner spaces stay, every other
/// byte becomes `%XX`, as do dots and spaces at either end. So no label leads out of its folder,
/// and different labels get different names.
pub(super) fn encode(label: &str) -> String {
    let last = label.len().saturating_sub(1);
    let mut name = String::with_capacity(label.len());
    for (at, byte) in label.bytes().enumerate() {
        let inner = at != 0 && at != last;
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'_' | b'-' => name.push(char::from(byte)),
            b'.' | b' ' if inner => name.push(char::from(byte)),
            // Writing to a string cannot fail.
            _ => write!(name, "%{byte:02X}").unwrap_or_default(),
        }
    }
    if name.len() > LONGEST {
        // The name is ASCII, so any cut is a character's boundary; the hash keeps names apart.
        name.truncate(LONGEST - 17);
        let hash = stable_hash(&[label.as_bytes()]);
        write!(name, "~{hash:016x}").unwrap_or_default();
    }
    name
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn common_labels_stay_as_they_are() {
        assert_eq!(encode("G1EpoxyRasterPlate"), "G1EpoxyRasterPlate");
        assert_eq!(encode("oak, sanded v1.2"), "oak%2C sanded v1.2");
    }

    #[test]
    fn no_label_leads_elsewhere() {
        assert_eq!(encode("../x"), "%2E.%2Fx");
        assert_eq!(encode(".."), "%2E%2E");
        assert_eq!(encode("."), "%2E");
        assert_eq!(encode("/etc"), "%2Fetc");
        assert_eq!(encode("a\\b\0"), "a%5Cb%00");
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
