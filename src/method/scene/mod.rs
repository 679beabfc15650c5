//! The sources of a station. A source is described by configuration, not by code of its own.
//!
//! Module `config` reads and checks a file; the program works with [`Scene`] and [`SourceSpec`].

#[doc(hidden)]
pub mod config;

use config::DomainName;
pub use config::LibraryToml;
pub(crate) use config::{MOST_CHANNELS, SourceBlock};

use std::borrow::Borrow;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

/// Short name of a source, such as `mi2`, made of letters, digits, `_` and `-`.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct SourceId(Arc<str>);

impl SourceId {
    /// Makes a source id of a name.
    ///
    /// # Errors
    /// If the name is empty or holds anything but letters, digits, `_` and `-`, since it also
    /// names a file.
    pub fn new(name: &str) -> Result<Self, SceneError> {
        let fits = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        if name.is_empty() || !name.chars().all(fits) {
            let problem = "cannot name a source; use letters, digits, `_` and `-`";
            return Err(SceneError(format!("`{name}` {problem}")));
        }
        Ok(Self(name.into()))
    }

    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for SourceId {
    type Error = SceneError;

    fn try_from(name: String) -> Result<Self, SceneError> {
        Self::new(&name)
    }
}

impl fmt::Display for SourceId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.0)
    }
}

impl Borrow<str> for SourceId {
    fn borrow(&self) -> &str {
        &self.0
    }
}

/// The domain in which samples are drawn from a source.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Domain {
    /// Random bins of the amplitude spectrum between two frequencies in Hz, both included.
    Spectrum { band_hz: (f64, f64) },
    /// Equidistant samples in time. `embedding` compares a band of frequencies, in Hz, if there is one.
    Time { band_hz: Option<(f64, f64)> },
    /// Pixels.
    Image,
}

impl Domain {
    /// The lowest and the highest frequency that are compared, in Hz; `None` if not configured.
    pub fn band_hz(&self) -> Option<(f64, f64)> {
        match *self {
            Self::Spectrum { band_hz } => Some(band_hz),
            Self::Time { band_hz } => band_hz,
            Self::Image => None,
        }
    }
}

/// The part of each pixel that is compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Colour {
    #[default]
    Hsv,
    Rgb,
    Hue,
    Saturation,
    Value,
}

/// The part of a scan that a source is cut from; parts are ordered by time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// A picture, which belongs to no part of the scan.
    Still,
    Tap,
    Drag,
}

/// Describes one source and how it is compared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SourceSpec {
    pub id: SourceId,
    pub what: String,
    pub sensor: String,
    pub phase: Phase,
    pub domain: Domain,
    pub colour: Colour,
    pub channels: usize,
    /// The sample rate that recordings must have, in Hz; `None` if any rate is accepted.
    pub rate_hz: Option<f64>,
    /// Whether the query's mean is shifted to the library trial's, channel by channel (Eq. 8).
    pub align_mean: bool,
    /// Exponent of the source's score in the discrepancy score (Eq. 9).
    pub weight: f64,
    /// The fixed length scale of the kernel; `None` if the median heuristic chooses the scale.
    pub sigma: Option<f64>,
    /// Added to the score n·MMD²_b.
    pub score_offset: f64,
}

impl SourceSpec {
    /// Whether the source is a switch, such as a metal detector, which may rest for a whole scan.
    /// Only switches have a fixed length scale.
    pub fn is_switch(&self) -> bool {
        self.sigma.is_some()
    }

    /// Makes the band end at `end_hz`; a band that began above `end_hz` then begins at 0.
    pub(crate) fn end_band_at(&mut self, end_hz: f64) {
        if let Domain::Spectrum { band_hz } | Domain::Time { band_hz: Some(band_hz) } =
            &mut self.domain
        {
            *band_hz = (if band_hz.0 < end_hz { band_hz.0 } else { 0.0 }, end_hz);
        }
    }

    /// Checks that the band reaches no higher than half the sample rate of a recording.
    ///
    /// # Errors
    /// If the band reaches higher; the error says what to do.
    pub fn check_rate(&self, rate_hz: f64) -> Result<(), String> {
        match self.domain.band_hz() {
            Some((low, high)) if high > rate_hz / 2.0 => Err(format!(
                "source `{}` has {rate_hz} Hz, but band_hz = [{low}, {high}] reaches above half of \
                 that; lower its upper end to {} in library.toml, or record with {} Hz or more",
                self.id,
                rate_hz / 2.0,
                2.0 * high,
            )),
            _ => Ok(()),
        }
    }
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scene {
    pub name: String,
    sources: BTreeMap<SourceId, SourceSpec>,
}

impl Scene {
    /// A scene of a single source, a series in time. Frequencies of `band_hz`, in Hz, are compared; if
    /// `None`, those up to 500 Hz or half of the rate.
    ///
    /// # Errors
    /// If there are no channels or more than 1024, if the rate is outside 0.001 Hz to 10 MHz, or if the
    /// band is empty or reaches above half of the rate.
    pub fn of_series(
        id: SourceId,
        channels: usize,
        rate_hz: f64,
        band_hz: Option<(f64, f64)>,
    ) -> Result<Self, SceneError> {
        let block = SourceBlock {
            domain: Some(DomainName::Time),
            channels: Some(channels),
            rate_hz: Some(rate_hz),
            band_hz: band_hz.map(|(low, high)| [low, high]),
            ..SourceBlock::default()
        };
        let spec = block.resolve(id.clone()).map_err(SceneError)?;
        Ok(Self { name: String::new(), sources: BTreeMap::from([(id, spec)]) })
    }

    /// This scene with the sources of `other`, which replace sources of the same name.
    pub fn with(mut self, other: Scene) -> Self {
        self.sources.extend(other.sources);
        if !other.name.is_empty() {
            self.name = other.name;
        }
        self
    }

    /// This scene, with `change` applied to each of its sources; `change` must keep the ids.
    pub fn changed(mut self, change: impl FnMut(&mut SourceSpec)) -> Self {
        self.sources.values_mut().for_each(change);
        self
    }

    /// This scene with only the named sources.
    ///
    /// # Errors
    /// If a name is not a source of the scene.
    pub fn only(mut self, names: &[SourceId]) -> Result<Self, SceneError> {
        if let Some(name) = names.iter().find(|name| !self.sources.contains_key(*name)) {
            let known = self.sources.keys().map(SourceId::as_str).collect::<Vec<_>>().join(", ");
            return Err(SceneError(format!("no source is called `{name}`; there are: {known}")));
        }
        self.sources.retain(|id, _| names.contains(id));
        Ok(self)
    }

    /// Sets the number of channels of a source. Adds a series if the scene lacks the source.
    pub(crate) fn set_channels(&mut self, id: SourceId, channels: usize) {
        let unknown = SourceBlock::default().resolve(id.clone());
        let spec = self.sources.entry(id);
        spec.or_insert(unknown.expect("an empty description is valid")).channels = channels;
    }

    pub fn get(&self, id: &str) -> Option<&SourceSpec> {
        self.sources.get(id)
    }

    /// Whether a source is a switch ([`SourceSpec::is_switch`]); false if the scene lacks the source.
    pub fn is_switch(&self, id: &SourceId) -> bool {
        self.get(id.as_str()).is_some_and(SourceSpec::is_switch)
    }

    /// Whether a source is recorded during the drag; false if the scene lacks the source.
    pub fn is_dragged(&self, id: &SourceId) -> bool {
        self.get(id.as_str()).is_some_and(|spec| spec.phase == Phase::Drag)
    }

    /// All sources, sorted by name.
    pub fn sources(&self) -> impl ExactSizeIterator<Item = &SourceSpec> {
        self.sources.values()
    }
}

/// Why a text describes no scene, or a name no source. The message names the line, if there is one.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct SceneError(pub(crate) String);
