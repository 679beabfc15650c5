//! Chooses the trials, sources and folds that a measurement works with.

use std::collections::BTreeSet;

use super::show::{counted, listed};
use super::{Failure, say};
use crate::evaluate::{self, EvaluateError, Fold, Leaks, Protocol, in_libraries};
use crate::library::{Entry, Library};
use crate::scene::{Scene, SourceId};
use crate::trial::TrialKey;

/// The trials, sources and folds of a measurement.
pub(super) struct Choice {
    pub scene: Scene,
    /// Trials that hold at least one of the scene's sources.
    pub entries: Vec<Entry>,
    pub protocol: Protocol,
    pub folds: Vec<Fold>,
    pub leaks: Leaks,
}

/// The trials that hold any source of `scene`, limited to these sources.
pub(super) fn within(library: &Library, scene: &Scene) -> Result<Vec<Entry>, Failure> {
    let entries = evaluate::within(&library.entries, scene);
    if entries.is_empty() {
        let wanted: BTreeSet<&SourceId> = scene.sources().map(|spec| &spec.id).collect();
        let held: BTreeSet<&SourceId> =
            library.entries.iter().flat_map(|entry| &entry.sources).collect();
        let held = if held.is_empty() { "none that is known".into() } else { listed(held) };
        let wanted = listed(wanted);
        return Err(Failure::Failed(format!(
            "{}: no trial holds {wanted}; sources that the data hold: {held}",
            library.name
        )));
    }
    Ok(entries)
}

/// The folds of the protocol `named` by the user, or of the hardest that fits (which is printed).
pub(super) fn split(
    keys: &[TrialKey],
    named: Option<Protocol>,
) -> Result<(Protocol, Vec<Fold>), EvaluateError> {
    let fitting = || Protocol::fitting(keys).unwrap_or(Protocol::LeaveOneTrialOut);
    let protocol = named.unwrap_or_else(fitting);
    let folds = evaluate::folds(protocol, keys)?;
    if named.is_none() {
        say!("protocol: {} ({})", protocol.name(), protocol.left_out());
    }
    Ok((protocol, folds))
}

/// Limits recordings to the sources of a scene, and splits them into folds; see [`split`].
pub(super) fn choose(
    library: &Library,
    scene: Scene,
    protocol: Option<Protocol>,
) -> Result<Choice, Failure> {
    let entries = within(library, &scene)?;
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let (protocol, folds) = split(&keys, protocol)?;
    let leaks = leaks(library, &entries);
    let (folds, warning) = kept_apart(folds, &keys, &leaks);
    warning.iter().for_each(|warning| say!("warning: {warning}"));
    Ok(Choice { scene, entries, protocol, folds, leaks })
}

/// Which trials share samples. Synthetic ones are made one by one, so they share none.
pub(super) fn leaks(library: &Library, entries: &[Entry]) -> Leaks {
    if library.synthetic { Leaks::default() } else { Leaks::of(entries, &say::progress) }
}

/// Takes trials that share samples with a query out of the library of its fold. Also returns a warning
/// if any do, which says if that cannot be done.
pub(super) fn kept_apart(
    folds: Vec<Fold>,
    keys: &[TrialKey],
    leaks: &Leaks,
) -> (Vec<Fold>, Option<String>) {
    let Some(found) = leaks.text(keys, |trial| keys[trial].to_string()) else {
        return (folds, None);
    };
    let Some(apart) = leaks.apart(&folds, keys) else {
        let why = "without these trials no library has two surfaces";
        let warning =
            format!("{found}; they cannot be kept together ({why}): the accuracy is too high");
        return (folds, Some(warning));
    };
    let queries = |folds: &[Fold]| folds.iter().map(|fold| fold.queries.len()).sum::<usize>();
    let lost = match queries(&folds) - queries(&apart) {
        0 => String::new(),
        lost => format!(
            "; {} not asked, since nothing else of their surface is left",
            counted(lost, "trial")
        ),
    };
    let kept = "kept together: none is named by the samples that it shares";
    (apart, Some(format!("{found}; {kept}{lost}")))
}

impl Choice {
    /// Keeps at most `most` of the surfaces in the folds, evenly spread over their sorted names,
    /// and drops the trials of all other surfaces.
    pub(super) fn keep_surfaces(&mut self, most: usize) -> Result<(), Failure> {
        let all: BTreeSet<&str> = self.surfaces().collect();
        let kept: BTreeSet<String> = (all.iter().enumerate())
            .filter(|(i, _)| (i + 1) * most / all.len() > i * most / all.len())
            .map(|(_, name)| (*name).to_string())
            .collect();
        let places: Vec<usize> = (0..self.entries.len())
            .filter(|&i| kept.contains(&self.entries[i].key.surface))
            .collect();
        self.leaks = self.leaks.among(&places);
        self.entries.retain(|entry| kept.contains(&entry.key.surface));
        let keys: Vec<TrialKey> = self.entries.iter().map(|entry| entry.key.clone()).collect();
        let folds = evaluate::folds(self.protocol, &keys)?;
        self.folds = kept_apart(folds, &keys, &self.leaks).0;
        Ok(())
    }

    /// The surface of each trial that is in the library of at least one fold.
    pub(super) fn surfaces(&self) -> impl Iterator<Item = &str> {
        in_libraries(&self.folds).into_iter().map(|i| self.entries[i].key.surface.as_str())
    }

    /// The sources that are held by trials of the folds, sorted.
    pub(super) fn held(&self) -> Vec<SourceId> {
        let of_folds = self.folds.iter().flat_map(|fold| fold.library.iter().chain(&fold.queries));
        let held: BTreeSet<&SourceId> = of_folds.flat_map(|&i| &self.entries[i].sources).collect();
        held.into_iter().cloned().collect()
    }
}
