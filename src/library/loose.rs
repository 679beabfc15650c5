//! Recordings that lie in no trial folder, such as `oak/scan 1.wav`, `oak/scan 2.wav`, …
//!
//! Each file holds one source of a trial. A name that begins with the name of a source, such as
//! `mi2_03.wav`, selects that source. Any other file holds the only source that `library.toml`
//! describes, or the sound of a drag if it describes none or several. The trial's number is the one at
//! the end of the name, if every name ends with a number and no source has a number twice. If not, the
//! files are numbered in the order of their names. Files of one surface and number form one trial.

use std::collections::{BTreeMap, BTreeSet};

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
    let place = |name: &&str| {
        let (named, number) = (source_of(name, scene), number_in(name).unwrap_or_default());
        let guessed = named.is_none();
        FilePlace { source: named.unwrap_or_else(|| usual.clone()), number, guessed }
    };
    let mut places: Vec<FilePlace> = names.iter().map(place).collect();
    let free = |name: &&str| number_in(name).is_some_and(|number| !taken.contains(&number));
    let different: BTreeSet<_> = places.iter().map(|place| (&place.source, place.number)).collect();
    if different.len() < names.len() || !names.iter().all(free) {
        let first = taken.iter().max().map_or(1, |most| most.saturating_add(1));
        let mut next: BTreeMap<SourceId, u32> = BTreeMap::new();
        for place in &mut places {
            let next = next.entry(place.source.clone()).or_insert(first);
            place.number = *next;
            *next = next.saturating_add(1);
        }
    }
    places
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
