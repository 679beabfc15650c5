//! Leaves out sources of a query if their sensor is dead or stuck. `trial/channel_flaws.rs` finds the
//! flaws.

use crate::scene::{Scene, SourceId};
use crate::trial::{Doubt, Signal, Trial, flaws_of};

/// Leaves out each source that has a stuck channel or a picture of one colour. Returns the query, and
/// a doubt for each source left out. A channel may rest in the query as long as it does in the library.
/// A switch may be constant too, since it rarely changes. Nothing is left out if no other source would
/// remain.
///
/// `rests` gives the share of time that each channel of a source rests in the library
/// ([`crate::recognise::EmbeddingModel::rests`]). Library trials are checked at enrolment, not here.
pub fn without_flawed<'a>(
    mut trial: Trial,
    scene: &Scene,
    rests: impl Fn(&SourceId) -> &'a [f32],
) -> (Trial, Vec<Doubt>) {
    let is_dead = |doubt: &Doubt| matches!(doubt, Doubt::Stuck { .. } | Doubt::OneColour { .. });
    let doubt_of =
        |id: &SourceId, signal: &Signal| flaws_of(id, signal, rests(id)).into_iter().find(is_dead);
    let sources = trial.signals.iter().map(|(id, signal)| (id, doubt_of(id, signal)));
    let left_out = left_out(scene, sources);
    trial.signals.retain(|id, _| !left_out.iter().any(|(other, _)| other == id));
    (trial, left_out.into_iter().map(|(_, doubt)| doubt).collect())
}

/// Decides which of `sources`, given with their flaws, to leave out. Switches stay. Nothing is left
/// out if no other source of the scene would remain.
pub(crate) fn left_out<'a, F>(
    scene: &Scene,
    sources: impl Iterator<Item = (&'a SourceId, Option<F>)>,
) -> Vec<(SourceId, F)> {
    let (mut flawed, mut sound) = (Vec::new(), 0);
    for (id, flaw) in sources {
        let Some(spec) = scene.get(id.as_str()) else { continue };
        match flaw {
            Some(flaw) if !spec.is_switch() => flawed.push((id.clone(), flaw)),
            _ => sound += 1,
        }
    }
    if sound == 0 { Vec::new() } else { flawed }
}
