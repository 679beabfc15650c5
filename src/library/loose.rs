//! Recordings that lie in no trial folder, such as `oak/scan 1.wav`, `oak/scan 2.wav`, …
//!
//! Each file holds one source of a trial. A name that begins with the name of a source, such as
//! `mi2_03.wav`, selects that source. Any other file holds the only source that `library.toml`
//! describes, or the sound of a drag if it describes none or several. The trial's number is the one at
//! the end of the name, if every name ends with a number and no source has a number twice. If not, the
//! files are numbered in the order of their names. Files of one surface and number form one trial.

use std::collections::BTreeSet;

use super::files::number_in;
use crate::scene::{Scene, SourceId};

/// The default source of a file, if neither the file's name nor `library.toml` selects another.
const USUAL: &str = "mi2";

#[derive(Clone, Debug, PartialEq)]
pub(super) struct FilePlace {
    pub source: SourceId,
    pub number: u32,
    /// Whether the file's name does not begin with the name of a source.
    pub guessed: bool,
}

/// The source and the trial number of each file in `names` (without extension), in order. `only` is
/// the only source that `library.toml` describes; numbers in `taken` belong to other trials.
pub(super) fn places(
    names: &[&str],
    scene: &Scene,
    only: Option<&SourceId>,
    taken: &[u32],
) -> Vec<FilePlace> {
    let usual = || scene.get(USUAL).map(|spec| spec.id.clone());
    let Some(usual) = only.cloned().or_else(usual) else { return Vec::new() };
    let named: Vec<Option<SourceId>> = names.iter().map(|name| source_of(name, scene)).collect();
    let source = |i: usize| named[i].clone().unwrap_or_else(|| usual.clone());
    let numbers = numbers(names, &source, taken);
    let place = |(i, number)| FilePlace { source: source(i), number, guessed: named[i].is_none() };
    numbers.into_iter().enumerate().map(place).collect()
}

/// The remark on files that were read as `source`, since their names begin with no source's name.
pub(super) fn remark(source: &SourceId) -> String {
    let what = if source.as_str() == USUAL { "sound of a drag" } else { "the source" };
    format!("read as {what} (`{source}`); begin the file name with another source to change that")
}

/// The source that `name` begins with, if no letter or digit follows; of several, the longest.
fn source_of(name: &str, scene: &Scene) -> Option<SourceId> {
    let begins = |id: &str| {
        let rest = name.strip_prefix(id)?;
        Some(!rest.starts_with(char::is_alphanumeric))
    };
    let longest = scene.sources().filter(|spec| begins(spec.id.as_str()) == Some(true));
    longest.max_by_key(|spec| spec.id.as_str().len()).map(|spec| spec.id.clone())
}

fn numbers(names: &[&str], source: &dyn Fn(usize) -> SourceId, taken: &[u32]) -> Vec<u32> {
    let all: Option<Vec<u32>> = names.iter().map(|name| number_in(name)).collect();
    if let Some(numbers) = all {
        let own: BTreeSet<_> = numbers.iter().enumerate().map(|(i, n)| (source(i), *n)).collect();
        if own.len() == names.len() && numbers.iter().all(|number| !taken.contains(number)) {
            return numbers;
        }
    }
    let first = taken.iter().max().map_or(1, |most| most.saturating_add(1));
    let counted = |i: usize| {
        let of_source = (0..i).filter(|&before| source(before) == source(i)).count() as u32;
        first.saturating_add(of_source)
    };
    (0..names.len()).map(counted).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn placed(names: &[&str], taken: &[u32]) -> Vec<(String, u32)> {
        let places = places(names, &Scene::lmt108(), None, taken);
        places.iter().map(|place| (place.source.to_string(), place.number)).collect()
    }

    #[test]
    fn names_say_source_and_number_where_they_can() {
        let of = |name: &str, number| (name.to_string(), number);
        assert_eq!(placed(&["scan 3", "scan 12"], &[]), [of("mi2", 3), of("mi2", 12)]);
        assert_eq!(placed(&["ac_1", "mi2-1"], &[]), [of("ac", 1), of("mi2", 1)]);
        assert_eq!(placed(&["ac"], &[]), [of("ac", 1)]);
        assert_eq!(placed(&["acorn1", "first"], &[]), [of("mi2", 1), of("mi2", 2)]);
        assert_eq!(placed(&["a1", "b1"], &[]), [of("mi2", 1), of("mi2", 2)], "one number twice");
        assert_eq!(placed(&["scan1", "scan2"], &[1]), [of("mi2", 2), of("mi2", 3)]);
    }
}
