//! Leaves out sources of a query if their sensor is dead or stuck. `trial/channel_flaws.rs` finds and
//! words the flaws.

use crate::scene::{Scene, SourceId};
use crate::trial::{Flaw, Signal, Trial, flaws, is_plain};

const PLAIN: &str = "the picture is of one colour";

/// Leaves out each source that has a stuck channel or a picture of one colour. Returns the query, and
/// one line of text for each source left out. A channel may be constant in the query if it is constant
/// in the library. A switch may be constant too, since it rarely changes. Nothing is left out if no
/// other source would remain.
///
/// `moves` says whether a channel of a source, counted from 0, varies in the library
/// ([`crate::recognise::EmbeddingModel::moves`]). Library trials are checked at enrolment, not here.
pub fn without_flawed(
    mut trial: Trial,
    scene: &Scene,
    moves: impl Fn(&SourceId, usize) -> bool,
) -> (Trial, Vec<String>) {
    let flaw_of = |id: &SourceId, signal: &Signal| match signal {
        Signal::Image(image) => is_plain(image).then(|| PLAIN.to_string()),
        Signal::Series(series) => flaws(series)
            .into_iter()
            .find(|flaw| match flaw {
                Flaw::Constant { .. } | Flaw::Stuck { .. } => moves(id, flaw.channel() - 1),
                Flaw::Saturated { .. } => false,
            })
            .map(|flaw| flaw.to_string()),
    };
    let sources = trial.signals.iter().map(|(id, signal)| (id, flaw_of(id, signal)));
    let left_out = left_out(scene, sources);
    trial.signals.retain(|id, _| !left_out.iter().any(|(other, _)| other == id));
    let remarks =
        left_out.into_iter().map(|(id, flaw)| format!("{id} is left out: {flaw}")).collect();
    (trial, remarks)
}

/// Decides which of `sources`, given with their flaws, to leave out. Switches (sources with a fixed σ)
/// stay. Nothing is left out if no other source of the scene would remain.
pub(crate) fn left_out<'a, F>(
    scene: &Scene,
    sources: impl Iterator<Item = (&'a SourceId, Option<F>)>,
) -> Vec<(SourceId, F)> {
    let (mut flawed, mut sound) = (Vec::new(), 0);
    for (id, flaw) in sources {
        let Some(spec) = scene.get(id.as_str()) else { continue };
        match flaw {
            Some(flaw) if spec.sigma.is_none() => flawed.push((id.clone(), flaw)),
            _ => sound += 1,
        }
    }
    if sound == 0 { Vec::new() } else { flawed }
}
