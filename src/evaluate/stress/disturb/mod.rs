//! Disturbances: pure functions of a trial, a severity and a seeded generator.
//!
//! The levels of each go from what a good station sees now and then (first), through a bad day, to
//! the absurd (last), so that places on the axes of different disturbances can be compared.

mod drag;
mod level;
pub mod library;
mod noise;
mod picture;
mod sensor;
mod setting;
mod timing;

use self::library::LibraryChange;
pub use self::setting::Setting;
use self::setting::{analog, any, drag, is_picture, many_channels, sensed, slow, sound};
use crate::scene::SourceSpec;
use crate::trial::Trial;

/// What is done to queries, or to the library.
#[derive(Clone, Copy)]
pub enum Kind {
    /// To each query.
    Query(fn(&mut Trial, &mut Setting<'_>)),
    /// To the library.
    Library(LibraryChange),
}

/// A disturbance with its axis of severities.
#[derive(Clone, Copy)]
pub struct Disturbance {
    /// Short name, by which it is chosen.
    pub name: &'static str,
    /// What the levels are, with their unit.
    pub axis: &'static str,
    /// Severities, from mild to absurd.
    pub levels: &'static [f64],
    /// What is done.
    pub kind: Kind,
    /// Which sources it changes.
    pub touches: fn(&SourceSpec) -> bool,
    /// How many sources it needs to make sense.
    pub fewest: usize,
}

/// All disturbances.
pub fn all() -> Vec<Disturbance> {
    let query = |name, axis, levels, change, touches| Disturbance {
        name,
        axis,
        levels,
        kind: Kind::Query(change),
        touches,
        fewest: 1,
    };
    let of_library = |name, axis, levels, change| Disturbance {
        name,
        axis,
        levels,
        kind: Kind::Library(change),
        touches: any,
        fewest: 1,
    };
    let several = |disturbance: Disturbance| Disturbance { fewest: 2, ..disturbance };
    vec![
        query("white-noise", "SNR, dB", &[40.0, 30.0, 20.0, 10.0, 0.0], noise::white, analog),
        query("red-noise", "SNR, dB", &[40.0, 30.0, 20.0, 10.0, 0.0], noise::red, analog),
        query(
            "room-noise",
            "sound over room, dB",
            &[30.0, 20.0, 10.0, 3.0, -10.0],
            noise::room,
            sound,
        ),
        query("gain", "factor", &[1.2, 1.5, 2.0, 4.0, 16.0], level::gain, analog),
        query("force", "factor", &[1.2, 1.5, 2.0, 3.0, 6.0], level::force, analog),
        query("offset", "deviations", &[0.2, 1.0, 3.0, 10.0, 100.0], level::offset, analog),
        query(
            "saturation",
            "limit over peak",
            &[0.7, 0.4, 0.2, 0.1, 0.03],
            level::saturation,
            analog,
        ),
        query("quantisation", "bits", &[12.0, 10.0, 8.0, 6.0, 3.0], level::quantisation, analog),
        query("dropped-samples", "share", &[0.001, 0.01, 0.05, 0.2, 0.6], timing::dropped, drag),
        query("gaps", "share, held", &[0.01, 0.05, 0.1, 0.3, 0.7], timing::gaps, drag),
        query("clock-error", "%", &[0.1, 0.5, 2.0, 5.0, 20.0], timing::clock, analog),
        query("short-scan", "s", &[2.0, 1.0, 0.5, 0.25, 0.05], timing::short, drag),
        query("slow-hand", "times closer than T*", &[1.5, 2.0, 4.0, 8.0, 32.0], timing::slow, slow),
        several(query("dead-sensors", "sources", &[1.0, 2.0, 3.0, 4.0, 6.0], sensor::dead, sensed)),
        several(query(
            "stuck-sensors",
            "sources",
            &[1.0, 2.0, 3.0, 4.0, 6.0],
            sensor::stuck,
            analog,
        )),
        query(
            "swapped-channels",
            "channels turned by",
            &[1.0, 2.0],
            sensor::swapped,
            many_channels,
        ),
        query("darkness", "light", &[0.9, 0.75, 0.5, 0.25, 0.05], picture::dark, is_picture),
        query(
            "white-balance",
            "red over blue",
            &[1.05, 1.1, 1.25, 1.5, 3.0],
            picture::tint,
            is_picture,
        ),
        query("image-shift", "pixels", &[2.0, 8.0, 32.0, 80.0, 160.0], picture::shift, is_picture),
        query("blur", "pixels", &[1.0, 2.0, 4.0, 10.0, 40.0], picture::blur, is_picture),
        query("stick-slip", "depth", &[0.1, 0.3, 0.6, 0.9, 1.0], drag::stick_slip, drag),
        query(
            "lift-offs",
            "share of the drag",
            &[0.02, 0.05, 0.15, 0.4, 0.8],
            drag::lift_offs,
            drag,
        ),
        of_library(
            "few-trials",
            "library trials a surface",
            &[7.0, 5.0, 3.0, 2.0, 1.0],
            library::few,
        ),
        of_library(
            "mislabelled",
            "share of the library",
            &[0.02, 0.05, 0.1, 0.2, 0.5],
            library::mislabelled,
        ),
        of_library(
            "twins",
            "difference of twins, % of pitch",
            &[10.0, 5.0, 2.0, 1.0, 0.3],
            library::twins,
        ),
    ]
}

impl Disturbance {
    /// Whether it changes anything of data with these sources.
    pub fn fits(&self, sources: &[&SourceSpec]) -> bool {
        sources.iter().filter(|spec| (self.touches)(spec)).count() >= self.fewest
    }
}

#[cfg(test)]
mod tests;
