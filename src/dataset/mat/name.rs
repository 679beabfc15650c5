//! Which trial each file is: by the authors' lists, or by the files' own names.

use std::collections::{BTreeMap, BTreeSet};

use crate::trial::{EXPERT, TrialKey};

/// What the files of one half of the database are.
pub(super) struct Listing {
    /// For each file its trial, or why it is none.
    pub keys: Vec<Result<TrialKey, String>>,
    /// For people.
    pub remarks: Vec<String>,
}

/// A name such as `G1Mesh_train3`: the surface, and the number if there is one.
fn split(stem: &str) -> (&str, Option<u32>) {
    let head = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    let number = stem[head.len()..].parse().ok();
    for word in ["training", "train", "testing", "test"] {
        let at = head.len().wrapping_sub(word.len());
        // `get` gives nothing where the word is longer than the name.
        if head.get(at..).is_some_and(|end| end.eq_ignore_ascii_case(word)) {
            return (head[..at].trim_end_matches('_'), number);
        }
    }
    match number {
        // Digits without a mark before them belong to the name: G1PlasticMeshVersion1.
        Some(number) if head.ends_with('_') => (head.trim_end_matches('_'), Some(number)),
        _ => (stem, None),
    }
}

fn key(surface: &str, number: u32, is_expert: bool) -> TrialKey {
    let user = if is_expert { EXPERT.to_string() } else { format!("user{number}") };
    TrialKey::new(surface, user, number)
}

/// The trials by the names of their files (without `.mat`).
pub(super) fn by_file(stems: &[&str], is_expert: bool) -> Listing {
    let one = |stem: &&str| match split(stem) {
        (surface, Some(number)) if !surface.is_empty() => Ok(key(surface, number, is_expert)),
        _ => Err("its name does not end with the number of the trial, as in G1Mesh_train1".into()),
    };
    Listing { keys: stems.iter().map(one).collect(), remarks: Vec::new() }
}

/// The trials that a list names, in order; `stems` are the files' names without `.mat`.
///
/// A number in a listed name is the trial's; where the names carry none, a trial's place in the list
/// among those of its surface is its number. A list that names no file at all, while the files'
/// names do not distinguish surfaces, is taken to name the files in their order.
pub(super) fn by_list(stems: &[&str], named: &[String], list: &str, is_expert: bool) -> Listing {
    // Folders and the extension are no part of a listed name.
    let named: Vec<&str> = (named.iter())
        .map(|name| name.rsplit(['/', '\\']).next().unwrap_or(name))
        .map(|name| name.strip_suffix(".mat").unwrap_or(name).trim())
        .filter(|name| !name.is_empty())
        .collect();
    let mut places: BTreeMap<&str, u32> = BTreeMap::new();
    let keys: Vec<TrialKey> = (named.iter())
        .map(|name| {
            let (surface, number) = split(name);
            let place = places.entry(surface).or_default();
            *place += 1;
            key(surface, number.unwrap_or(*place), is_expert)
        })
        .collect();
    let listed: BTreeMap<String, &TrialKey> =
        named.iter().map(|name| name.to_ascii_lowercase()).zip(&keys).collect();
    let own = by_file(stems, is_expert).keys;
    let find = |stem: &str, own: &Result<TrialKey, String>| {
        let by_name = listed.get(&stem.to_ascii_lowercase()).map(|&key| key.clone());
        by_name.or_else(|| own.as_ref().ok().filter(|key| keys.contains(key)).cloned())
    };
    let found: Vec<Option<TrialKey>> =
        stems.iter().zip(&own).map(|(stem, own)| find(stem, own)).collect();

    let mut remarks = Vec::new();
    if found.iter().all(Option::is_none) {
        let surfaces = own.iter().flatten().map(|key| &key.surface).collect::<BTreeSet<_>>().len();
        if surfaces < 2 && keys.len() == stems.len() {
            remarks.push(format!(
                "{list}: it names no file; its entries were taken for the files in their order"
            ));
            return Listing { keys: in_order(stems, keys), remarks };
        }
        remarks.push(format!("{list}: it names none of the files; their own names are used"));
        return Listing { keys: own, remarks };
    }
    let unlisted = found.iter().filter(|key| key.is_none()).count();
    if unlisted > 0 {
        let files = if unlisted == 1 { "1 file is" } else { &format!("{unlisted} files are") };
        remarks.push(format!("{list}: {files} not in it; the files' own names are used"));
    }
    let absent = keys.iter().filter(|key| !found.iter().flatten().any(|f| f == *key)).count();
    if absent > 0 {
        remarks.push(format!("{list}: {absent} of its {} trials have no file", keys.len()));
    }
    let keys = found.into_iter().zip(own).map(|(found, own)| found.map_or(own, Ok)).collect();
    Listing { keys, remarks }
}

/// The n-th key for the n-th file, counted as people do: file 2 comes before file 10.
fn in_order(stems: &[&str], keys: Vec<TrialKey>) -> Vec<Result<TrialKey, String>> {
    let mut order: Vec<usize> = (0..stems.len()).collect();
    order.sort_by_key(|&at| {
        let head = stems[at].trim_end_matches(|c: char| c.is_ascii_digit());
        (head, stems[at][head.len()..].parse::<u64>().unwrap_or(0))
    });
    let mut placed: Vec<(usize, TrialKey)> = order.into_iter().zip(keys).collect();
    placed.sort_by_key(|(at, _)| *at);
    placed.into_iter().map(|(_, key)| Ok(key)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(listing: &Listing) -> Vec<String> {
        let name = |key: &Result<TrialKey, String>| match key {
            Ok(key) => format!("{} {} {}", key.surface, key.user, key.number),
            Err(why) => why.clone(),
        };
        listing.keys.iter().map(name).collect()
    }

    fn owned(names: &[&str]) -> Vec<String> {
        names.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_name_holds_surface_and_number() {
        assert_eq!(split("G1PlasticMeshVersion1_train10"), ("G1PlasticMeshVersion1", Some(10)));
        assert_eq!(split("G1Mesh_3"), ("G1Mesh", Some(3)));
        assert_eq!(split("G1Meshtest3"), ("G1Mesh", Some(3)));
        assert_eq!(split("G1PlasticMeshVersion1"), ("G1PlasticMeshVersion1", None));
    }

    #[test]
    fn a_list_gives_numbers_by_name_or_by_place() {
        let listing =
            by_list(&["a_train1", "a_train2"], &owned(&["x/a_train2.mat", "a_train1"]), "l", true);
        assert_eq!(names(&listing), ["a expert 1", "a expert 2"]);
        assert!(listing.remarks.is_empty());
        let listing = by_list(&["10", "9"], &owned(&["a", "b"]), "l", false);
        assert_eq!(names(&listing), ["b user1 1", "a user1 1"]);
        assert!(listing.remarks[0].contains("taken for the files in their order"));
    }

    #[test]
    fn a_list_that_does_not_fit_is_said() {
        let listing = by_list(&["a_test1", "b_test1"], &owned(&["a_test1", "c_test1"]), "l", false);
        assert_eq!(names(&listing), ["a user1 1", "b user1 1"]);
        assert_eq!(listing.remarks.len(), 2, "{:?}", listing.remarks);
        let listing = by_list(&["a_1", "b_1"], &owned(&["x", "y"]), "l", true);
        assert_eq!(names(&listing), ["a expert 1", "b expert 1"]);
        assert!(listing.remarks[0].contains("none of the files"));
    }
}
