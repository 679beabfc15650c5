//! The reference surfaces of a library: parts that are scanned again and again to find drift. They stand
//! in `library.toml`, each with the moment from which its scans count:
//!
//! ```toml
//! reference = { "golden part" = 2026-01-31T12:00:00Z }
//! ```

use std::collections::BTreeMap;
use std::path::Path;

use jiff::{Timestamp, Unit};

use super::edit::LibraryLock;
use super::replace_file;
use crate::library::recording::DESCRIPTION;
use crate::library::{LibraryError, files};
use crate::scene::{LibraryToml, Scene};
use crate::trial::normal;

/// The reference surfaces of a library, each with the moment from which its scans count, in
/// milliseconds since 1970.
///
/// # Errors
/// If `library.toml` cannot be read, or is wrong.
pub fn references(library: &Path) -> Result<BTreeMap<String, u64>, LibraryError> {
    let unix_ms = |since: Timestamp| u64::try_from(since.as_millisecond()).unwrap_or(0);
    let all = described(library)?.1.reference.into_iter();
    Ok(all.map(|(surface, since)| (normal(&surface), unix_ms(since))).collect())
}

/// The text of `library.toml`, and what it says; the shortest such text if there is no file.
fn described(library: &Path) -> Result<(String, LibraryToml), LibraryError> {
    let path = library.join(DESCRIPTION);
    let text = files::read_text_if_there(&path)?.unwrap_or_else(|| "format = 1\n".into());
    let described = LibraryToml::parse(&text, &Scene::lmt108()).map_err(LibraryError::at(&path))?;
    Ok((text, described))
}

/// Makes a surface a reference whose scans count from now on or, with `None`, no reference. The rest of
/// `library.toml` stays as it is; the file is made if there is none.
///
/// # Errors
/// If `library.toml` cannot be read or written, is wrong, or has `reference` in several lines.
pub fn set_reference(
    library: &Path,
    surface: &str,
    since: Option<Timestamp>,
) -> Result<(), LibraryError> {
    let _lock = LibraryLock::for_editing(library)?;
    let path = library.join(DESCRIPTION);
    let (text, LibraryToml { mut reference, places: (format, value), .. }) = described(library)?;
    reference.retain(|other, _| normal(other) != normal(surface));
    if let Some(since) = since {
        let whole = since.round(Unit::Second).unwrap_or(since);
        reference.insert(surface.into(), whole);
    }
    let one = |(surface, since): (&String, &Timestamp)| {
        format!("{} = {since}", toml::Value::from(surface.as_str()))
    };
    let all: Vec<String> = reference.iter().map(one).collect();
    let line = format!("reference = {{ {} }}", all.join(", "));
    let end_of_line = |at: usize| text[at..].find('\n').map_or(text.len(), |end| at + end + 1);
    let (from, to) = match value {
        Some(value) => {
            let begin = text[..value.start].rfind('\n').map_or(0, |end| end + 1);
            let is_one_line = text[begin..value.start].trim_start().starts_with("reference")
                && text[value.clone()].starts_with('{')
                && !text[value.clone()].contains('\n');
            if !is_one_line {
                let line = "reference = { \"oak\" = 2026-01-31T12:00:00Z }";
                let problem = format!(
                    "`reference` is not written as one line, so it is left as it is; write it as \
                     {line}, or edit it by hand"
                );
                return Err(LibraryError::file(&path, problem));
            }
            (begin, end_of_line(value.end))
        }
        None => (end_of_line(format.end), end_of_line(format.end)),
    };
    // The line before may be the last one, without its end.
    let gap = if text[..from].is_empty() || text[..from].ends_with('\n') { "" } else { "\n" };
    let line = if reference.is_empty() { String::new() } else { line + "\n" };
    let text = format!("{}{gap}{line}{}", &text[..from], &text[to..]);
    replace_file(&path, text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(library: &Path, surface: &str, since: Option<&str>) -> Result<String, LibraryError> {
        let since = since.map(|since| since.parse().unwrap());
        set_reference(library, surface, since)?;
        Ok(std::fs::read_to_string(library.join(DESCRIPTION)).unwrap())
    }

    #[test]
    fn a_reference_is_set_renewed_and_taken_away_and_the_rest_of_the_file_stays() {
        let folder = tempfile::tempdir().unwrap();
        let library = folder.path();
        assert_eq!(references(library).unwrap(), BTreeMap::new());
        let (first, later) = ("2026-01-31T12:00:00.4Z", "2026-02-01T00:00:00Z");
        let made = set(library, "oak", Some(first)).unwrap();
        assert_eq!(made, "format = 1\nreference = { \"oak\" = 2026-01-31T12:00:00Z }\n");
        let text = "# mine\nformat = 1 # one\n\n# these\n[sources.mi2]\nchannels = 2";
        std::fs::write(library.join(DESCRIPTION), text).unwrap();
        set(library, "oak", Some(first)).unwrap();
        let both = set(library, "a \"b\" = c", Some(later)).unwrap();
        assert!(both.starts_with("# mine\nformat = 1 # one\nreference = { "), "{both}");
        assert!(both.ends_with("}\n\n# these\n[sources.mi2]\nchannels = 2"), "{both}");
        let (oak_ms, later_ms) = (1_769_860_800_000, 1_769_904_000_000);
        let both = [("oak".into(), oak_ms), ("a \"b\" = c".into(), later_ms)];
        assert_eq!(references(library).unwrap(), BTreeMap::from(both));
        set(library, "oak", Some(later)).unwrap();
        assert_eq!(references(library).unwrap()["oak"], later_ms);
        set(library, "oak", None).unwrap();
        assert_eq!(set(library, "a \"b\" = c", None).unwrap(), text);
    }

    #[test]
    fn a_reference_that_was_written_otherwise_is_read_and_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let text = "format = 1\n[reference]\noak = 2026-01-31T12:00:00Z\n";
        std::fs::write(folder.path().join(DESCRIPTION), text).unwrap();
        assert_eq!(references(folder.path()).unwrap().len(), 1);
        let error = set(folder.path(), "oak", None).unwrap_err().to_string();
        assert!(error.contains("not written as one line"), "{error}");
        for wrong in ["reference = [\"oak\"]", "reference = { oak = 2026-01-31 }"] {
            std::fs::write(folder.path().join(DESCRIPTION), format!("format = 1\n{wrong}"))
                .unwrap();
            let error = references(folder.path()).unwrap_err().to_string();
            assert!(error.contains("line 2"), "{error}");
        }
    }
}
