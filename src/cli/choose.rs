//! Chooses the trials, sources and folds that a measurement works with.

use std::collections::BTreeSet;

use clap::ValueEnum;
use clap::builder::PossibleValue;

use super::Failure;
use crate::evaluate::{self, EvaluateError, Fold, Protocol};
use crate::library::{Entry, Library};
use crate::scene::{Scene, SourceId};
use crate::trial::TrialKey;

/// The trials, sources and folds of a measurement.
pub(super) struct Choice {
    /// The sources to compare.
    pub scene: Scene,
    /// Trials that hold some of these sources.
    pub entries: Vec<Entry>,
    pub protocol: Protocol,
    pub folds: Vec<Fold>,
}

/// The trials that hold any source of `scene`, with these sources only.
///
/// # Errors
/// If no trial holds any.
pub(super) fn within(library: &Library, scene: &Scene) -> Result<Vec<Entry>, Failure> {
    let entries: Vec<Entry> = (library.entries.iter())
        .map(|entry| entry.clone().within(scene))
        .filter(|entry| !entry.sources.is_empty())
        .collect();
    if entries.is_empty() {
        let list = |ids: BTreeSet<&SourceId>| {
            ids.into_iter().map(SourceId::as_str).collect::<Vec<_>>().join(", ")
        };
        let wanted = list(scene.sources().map(|spec| &spec.id).collect());
        let held = list(library.entries.iter().flat_map(|entry| &entry.sources).collect());
        let held = if held.is_empty() { "none that is known".into() } else { held };
        return Err(Failure::Failed(format!(
            "{}: no trial holds {wanted}; sources that the data hold: {held}",
            library.name
        )));
    }
    Ok(entries)
}

/// The named protocol, or else the one that fits the trials, which is then printed; and its folds.
///
/// # Errors
/// If the protocol finds no folds.
pub(super) fn split(
    keys: &[TrialKey],
    named: Option<Protocol>,
) -> Result<(Protocol, Vec<Fold>), EvaluateError> {
    let protocol = named.unwrap_or_else(|| Protocol::natural(keys));
    let folds = evaluate::folds(protocol, keys)?;
    if named.is_none() {
        say!("protocol: {}, which fits these data", protocol.name());
    }
    Ok((protocol, folds))
}

/// Narrows recordings to a scene, and splits them into folds by a protocol, see [`split`].
///
/// # Errors
/// If no trial holds any of the scene's sources, or the protocol finds no folds.
pub(super) fn choose(
    library: &Library,
    scene: Scene,
    protocol: Option<Protocol>,
) -> Result<Choice, Failure> {
    let entries = within(library, &scene)?;
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let (protocol, folds) = split(&keys, protocol)?;
    Ok(Choice { scene, entries, protocol, folds })
}

impl Choice {
    /// Keeps up to `most` of the surfaces that the folds use, evenly spread over their names, and
    /// drops the trials of all others.
    pub fn keep_surfaces(&mut self, most: usize) -> Result<(), Failure> {
        let all: BTreeSet<&str> = self.surfaces().collect();
        let kept: BTreeSet<String> = (all.iter().enumerate())
            .filter(|(i, _)| (i + 1) * most / all.len() > i * most / all.len())
            .map(|(_, name)| (*name).to_string())
            .collect();
        self.entries.retain(|entry| kept.contains(&entry.key.surface));
        let keys: Vec<TrialKey> = self.entries.iter().map(|entry| entry.key.clone()).collect();
        self.folds = evaluate::folds(self.protocol, &keys)?;
        Ok(())
    }

    /// The surface of each trial in some fold's library.
    pub fn surfaces(&self) -> impl Iterator<Item = &str> {
        let of_fold = |fold: &Fold| fold.library.clone();
        let used: BTreeSet<usize> = self.folds.iter().flat_map(of_fold).collect();
        used.into_iter().map(|i| self.entries[i].key.surface.as_str())
    }

    /// The sources that trials of the folds hold, sorted.
    pub fn held(&self) -> Vec<SourceId> {
        let of_fold =
            |fold: &Fold| fold.library.iter().chain(&fold.queries).copied().collect::<Vec<_>>();
        let used: BTreeSet<usize> = self.folds.iter().flat_map(of_fold).collect();
        let held: BTreeSet<&SourceId> =
            used.into_iter().flat_map(|i| &self.entries[i].sources).collect();
        held.into_iter().cloned().collect()
    }
}

impl ValueEnum for Protocol {
    fn value_variants<'a>() -> &'a [Self] {
        &Self::ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        let help = match self {
            Protocol::ExpertVsUsers => {
                "The expert's trials are the library; each other user is a fold of queries (1 vs 10)"
            }
            Protocol::LeaveOneTrialOut => {
                "Fold k: trial k of every surface against the same person's other trials (1 vs 1)"
            }
            Protocol::AllVsOneUser => {
                "Each user is a fold; the library is everybody else (10 vs 1)"
            }
            Protocol::RandomHalves => {
                "50 folds: a random half of a person's trials of each surface against the other half"
            }
        };
        Some(PossibleValue::new(self.name()).help(help))
    }
}
