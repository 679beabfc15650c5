//! Reads surface, person, trial and session from the names of files, by a pattern.

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

use crate::library::files::number_in;
use crate::trial::{EXPERT, TrialKey, normal};

/// A pattern for file paths: text, the fields `{surface}`, `{user}`, `{trial}` and `{session}`, and
/// `*` for any text. Fields and `*` match at least one character, but no `/`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamePattern(pub String);

impl NamePattern {
    /// `option` is the option that gave the pattern. Reads surface, user, trial (text that ends with the number) and session from as many last parts
    /// of the path `name` as the pattern has. A trial of digits alone comes before other texts, and takes
    /// all of its digits.
    ///
    /// # Errors
    /// If the pattern does not fit, or fits in several ways.
    pub(super) fn parts(&self, name: &str, option: &str) -> Result<Parts, String> {
        let depth = self.0.matches('/').count();
        let from = name.rmatch_indices('/').nth(depth).map_or(0, |(at, _)| at + 1);
        let mut found = Fits { left: 100_000, all: Vec::new() };
        found.add(&self.0, &name[from..], &mut Parts::default());
        let digits = |parts: &Parts| {
            let number = parts[2].as_ref().filter(|text| text.bytes().all(|b| b.is_ascii_digit()));
            number.map_or(0, String::len)
        };
        let most = found.all.iter().map(digits).max().unwrap_or_default();
        let mut all = found.all.iter().filter(|parts| digits(parts) == most);
        let pattern = &self.0;
        match (all.next(), all.next()) {
            (None, _) => {
                Err(format!("its name does not fit the pattern `{pattern}`; see {option}"))
            }
            (Some(only), None) if found.left > 0 => Ok(only.clone()),
            (Some(one), other) => {
                let said = |parts: &Parts| {
                    parts
                        .iter()
                        .flatten()
                        .map(|part| format!("`{part}`"))
                        .collect::<Vec<_>>()
                        .join(", ")
                };
                Err(format!(
                    "its name fits the pattern `{pattern}` in several ways ({} or {}); give {option} a \
                     pattern with as many separators as the name has",
                    said(one),
                    said(other.unwrap_or(one))
                ))
            }
        }
    }
}

/// Surface, user, trial and session of a name.
pub(super) type Parts = [Option<String>; 4];

/// The different ways in which a pattern fits a name.
struct Fits {
    /// How many more comparisons are made, since there may be very many ways.
    left: usize,
    all: Vec<Parts>,
}

impl Fits {
    fn add(&mut self, pattern: &str, name: &str, parts: &mut Parts) {
        let fields = ["{surface}", "{user}", "{trial}", "{session}", "*"];
        self.left = self.left.saturating_sub(1);
        if self.left == 0 {
            return;
        }
        let Some(field) = fields.iter().position(|field| pattern.starts_with(field)) else {
            match (pattern.chars().next(), name.chars().next()) {
                (None, None) if !self.all.contains(parts) => self.all.push(parts.clone()),
                (Some(a), Some(b)) if a == b => {
                    self.add(&pattern[a.len_utf8()..], &name[b.len_utf8()..], parts);
                }
                _ => {}
            }
            return;
        };
        let ends = name.char_indices().map(|(at, c)| (at + c.len_utf8(), c));
        for (end, _) in ends.take_while(|(_, c)| *c != '/') {
            if let Some(part) = parts.get_mut(field) {
                *part = Some(name[..end].to_string());
            }
            self.add(&pattern[fields[field].len()..], &name[end..], parts);
        }
    }
}

/// The path of a file without its extensions, with `/` on every system: what a [`NamePattern`] fits.
pub(super) fn name_of(path: &Path) -> String {
    // `./3.csv` lies in a folder with a name, too.
    let is_relative =
        |part: Component<'_>| matches!(part, Component::CurDir | Component::ParentDir);
    let found = path.components().any(is_relative).then(|| path.canonicalize().ok()).flatten();
    let name = found.as_deref().unwrap_or(path).to_string_lossy().replace('\\', "/");
    let name = name.strip_suffix(".gz").unwrap_or(&name);
    Path::new(name).with_extension("").to_string_lossy().into_owned()
}

/// The surface, user and number that the names of files give, before any is read.
pub fn named(paths: &[PathBuf], names: &NamePattern) -> BTreeSet<TrialKey> {
    let key = |path: &PathBuf| {
        let [surface, user, number, _] = names.parts(&name_of(path), "--names").ok()?;
        let number = number.and_then(|text| trial_number(&text)).unwrap_or(1);
        let user = user.unwrap_or_else(|| EXPERT.into());
        Some(TrialKey::new(normal(&surface?), normal(&user), number))
    };
    paths.iter().filter_map(key).collect()
}

/// The number of a trial: `3`, `3.0`, or the digits at the end of a name; `None` for `1.5`.
pub(super) fn trial_number(text: &str) -> Option<u32> {
    match text.replace(',', ".").parse::<f64>() {
        Ok(number) => (number.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&number))
            .then_some(number as u32),
        Err(_) => number_in(text),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_by_their_pattern() {
        for (pattern, name, found) in [
            ("{surface}/{trial}", "a/Eiche/3", ["Eiche", "", "3", ""]),
            ("{surface}_{user}_{trial}", "oak_anna_07", ["oak", "anna", "07", ""]),
            ("{user}/*-{surface}_{trial}", "x/ben/run-oak 2_4", ["oak 2", "ben", "4", ""]),
            ("{session}/{surface}_{trial}", "x/monday/oak_4", ["oak", "", "4", "monday"]),
            ("{surface}_{trial}", "brushed_steel_12", ["brushed_steel", "", "12", ""]),
            ("{surface}{trial}", "oak01", ["oak", "", "01", ""]),
            ("*_{surface}", "1_oak", ["oak", "", "", ""]),
        ] {
            let parts = NamePattern(pattern.into()).parts(name, "--names").unwrap();
            assert_eq!(parts.map(Option::unwrap_or_default), found);
        }
        for (pattern, name, why) in [
            ("{surface}_{trial}", "oak".to_string(), "does not fit"),
            ("{surface}_{user}_{trial}", "cast_steel_ben_3".into(), "`cast`, `steel_ben`, `3` or"),
            ("{surface}x{user}x{trial}x*x*x*", "x".repeat(250), "in several ways"),
        ] {
            let found = NamePattern(pattern.into()).parts(&name, "--names").unwrap_err();
            assert!(found.contains(why), "{found}");
        }
    }
}
