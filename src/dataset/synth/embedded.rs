//! The scene that is played where no data are given: small, and with what makes naming hard.

use super::{Parameters, Twins, library, surface_name};
use crate::library::{Entry, Library};
use crate::scene::SourceId;
use crate::trial::{EXPERT, Series, Signal, Trial, TrialKey};

/// Surfaces that the expert has recorded, or all but the last of them.
const SURFACES: usize = 13;
/// Two surfaces of one material that are almost alike.
const TWINS: Twins = Twins { original: 1, twin: 10, distance: 0.05 };
/// The surface that the library lacks.
const UNKNOWN: usize = 12;
/// The scan whose acceleration is a dead line.
const DEAD: (usize, u32) = (5, 2);
/// The source that is dead in it.
const DEAD_SOURCE: &str = "ac";

/// The scene, and what to look for in it.
#[derive(Clone, Debug)]
pub struct Embedded {
    /// Four trials of each surface but one by the expert, to compare with, and a trial of every
    /// surface by each of three users, to be named.
    pub library: Library,
    /// For people: what is hard about it, a line each.
    pub remarks: Vec<String>,
}

/// The scene that is played where no data are given.
///
/// A dozen surfaces that are easy to distinguish, but for three things that stations meet: two of
/// them are almost alike, the library lacks a thirteenth, and a sensor is dead in one scan.
pub fn embedded() -> Embedded {
    let size = Parameters { surfaces: SURFACES, trials: 4, users: 3, ..Parameters::default() };
    let mut library = library(&Parameters { twins: Some(TWINS), ..size });
    let [original, twin, unknown] = [TWINS.original, TWINS.twin, UNKNOWN].map(surface_name);
    library.entries.retain(|entry| entry.key.surface != unknown || entry.key.user != EXPERT);
    let dead = TrialKey::new(surface_name(DEAD.0), format!("user{}", DEAD.1), DEAD.1);
    let silence = |entry: Entry| match entry.key == dead {
        true => entry.changed(with_a_dead_line),
        false => entry,
    };
    library.entries = library.entries.into_iter().map(silence).collect();
    let remarks = vec![
        format!("{original} and {twin} are almost alike"),
        format!("{unknown} is not in the library"),
        format!("the accelerometer is dead in the scan of {} by {}", dead.surface, dead.user),
    ];
    Embedded { library, remarks }
}

/// The trial with its acceleration at rest.
fn with_a_dead_line(mut trial: Trial) -> Trial {
    for (id, signal) in &mut trial.signals {
        if let (Signal::Series(series), true) = (&*signal, is_dead(id)) {
            let still = vec![0.0; series.samples().len()];
            let dead = Series::new(series.rate_hz(), series.channels(), still);
            // As long as the series that was there, and as regular.
            *signal = Signal::Series(dead.expect("zeros at a rate that was one"));
        }
    }
    trial
}

fn is_dead(id: &SourceId) -> bool {
    id.as_str() == DEAD_SOURCE
}
