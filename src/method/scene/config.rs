//! Parses and checks the TOML form of a scene, and turns it into a [`Scene`].

use std::collections::BTreeMap;
use std::ops::Range;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::{Colour, Domain, Phase, Scene, SceneError, SourceId, SourceSpec};

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneFile {
    format: toml::Spanned<u32>,
    name: Option<String>,
    /// Text for readers of the file; the program ignores it.
    notes: Option<String>,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    synthetic: bool,
    /// The reference surfaces, each with the moment from which its scans count.
    #[serde(skip_serializing_if = "Option::is_none")]
    reference: Option<toml::Spanned<BTreeMap<String, toml::value::Datetime>>>,
    #[serde(default)]
    sources: BTreeMap<String, toml::Spanned<SourceBlock>>,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DomainName {
    Spectrum,
    Time,
    Image,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourceBlock {
    pub what: Option<String>,
    pub sensor: Option<String>,
    pub phase: Option<Phase>,
    pub domain: Option<DomainName>,
    pub colour: Option<Colour>,
    pub channels: Option<usize>,
    pub rate_hz: Option<f64>,
    pub band_hz: Option<[f64; 2]>,
    pub align_mean: Option<bool>,
    pub weight: Option<f64>,
    pub sigma: Option<f64>,
    pub score_offset: Option<f64>,
}

/// A link to `configs`, so that the package holds the file; Git without links writes a path instead.
const SOURCES: &str = include_str!("sources.toml");
const _: () = assert!(SOURCES.len() > 99, "sources.toml is a link: check out with core.symlinks");

impl Scene {
    pub fn lmt108() -> Self {
        // This cannot fail, since a test parses the embedded file.
        Self::from_toml(SOURCES).expect("the embedded scene parses")
    }

    /// A scene from the text of a TOML file (`configs/sources.toml` shows the form).
    ///
    /// # Errors
    /// If the text is not TOML, has an unknown key, or describes an impossible source. The error
    /// names the line.
    pub fn from_toml(text: &str) -> Result<Self, SceneError> {
        Ok(LibraryToml::parse(text, &Self::default())?.sources)
    }

    /// The text of a `library.toml` with this scene; [`LibraryToml::parse`] reads it.
    pub fn to_library_toml(&self, synthetic: bool) -> String {
        let spanned = |block| toml::Spanned::new(0..0, block);
        let block = |spec: &SourceSpec| (spec.id.to_string(), spanned(SourceBlock::of(spec)));
        let file = SceneFile {
            format: toml::Spanned::new(0..0, 1),
            name: (!self.name.is_empty()).then(|| self.name.clone()),
            notes: None,
            synthetic,
            reference: None,
            sources: self.sources().map(block).collect(),
        };
        // This cannot fail, since TOML can express all that a scene holds (strings, numbers, tables).
        toml::to_string(&file).expect("a scene is plain TOML")
    }
}

/// Number of the line that holds byte `at` of a text, counted from 1.
pub fn line_of(text: &str, at: usize) -> usize {
    1 + text.bytes().take(at).filter(|byte| *byte == b'\n').count()
}

#[derive(Clone, Debug, PartialEq)]
pub struct LibraryToml {
    /// The sources that the file describes, and the library's name.
    pub sources: Scene,
    /// The file's own description of each source, which takes precedence over the defaults.
    pub(crate) declared: BTreeMap<SourceId, SourceBlock>,
    pub synthetic: bool,
    /// The reference surfaces, each with the moment from which its scans count.
    pub(crate) reference: BTreeMap<String, Timestamp>,
    /// Places in the text of `format` and of the value of `reference`, in bytes.
    pub(crate) places: (Range<usize>, Option<Range<usize>>),
}

impl LibraryToml {
    /// Parses the file's text. A source that `defaults` know as well takes its missing settings
    /// from them, unless the file gives it another domain.
    ///
    /// # Errors
    /// The same as for [`Scene::from_toml`].
    pub fn parse(text: &str, defaults: &Scene) -> Result<Self, SceneError> {
        let file = SceneFile::parse(text)?;
        let declared = |(name, block): (&String, &toml::Spanned<SourceBlock>)| {
            Some((SourceId::new(name).ok()?, block.get_ref().clone()))
        };
        let declared = file.sources.iter().filter_map(declared).collect();
        let places = (file.format.span(), file.reference.as_ref().map(toml::Spanned::span));
        let reference = file.reference.map(|all| references(all, text)).transpose()?;
        let sources = scene(file.name.unwrap_or_default(), file.sources, text, defaults)?;
        let (reference, synthetic) = (reference.unwrap_or_default(), file.synthetic);
        Ok(Self { sources, declared, synthetic, reference, places })
    }
}

/// The moments of the reference surfaces; `text` is the file's text, in which errors find their line.
fn references(
    all: toml::Spanned<BTreeMap<String, toml::value::Datetime>>,
    text: &str,
) -> Result<BTreeMap<String, Timestamp>, SceneError> {
    let line = line_of(text, all.span().start);
    let moment = |(surface, since): (String, toml::value::Datetime)| {
        let since = since.to_string().parse().map_err(|_| {
            let expected = "expected a date, a time and its zone, such as 2026-01-31T12:00:00Z";
            SceneError(format!("line {line}: reference `{surface}` = {since}; {expected}"))
        })?;
        Ok((surface, since))
    };
    all.into_inner().into_iter().map(moment).collect()
}

impl SceneFile {
    fn parse(text: &str) -> Result<Self, SceneError> {
        let file: Self = toml::from_str(text).map_err(|error| SceneError(error.to_string()))?;
        match *file.format.get_ref() {
            1 => Ok(file),
            found => {
                let line = line_of(text, file.format.span().start);
                let problem = "but this program reads format 1; update surfaced";
                Err(SceneError(format!("line {line}: format = {found}, {problem}")))
            }
        }
    }
}

/// Makes a scene of the `blocks` of a file. `text` is the file's text, in which errors find their
/// line. A source that `defaults` know as well takes its missing settings from them.
pub fn scene(
    name: String,
    blocks: BTreeMap<String, toml::Spanned<SourceBlock>>,
    text: &str,
    defaults: &Scene,
) -> Result<Scene, SceneError> {
    let mut sources = BTreeMap::new();
    for (name, block) in blocks {
        let fail = |problem: String| {
            let line = line_of(text, block.span().start);
            SceneError(format!("line {line}: source `{name}`: {problem}"))
        };
        let id = SourceId::new(&name).map_err(|error| fail(error.to_string()))?;
        let block = block.get_ref().over(defaults.get(id.as_str()));
        let spec = block.resolve(id.clone()).map_err(fail)?;
        sources.insert(id, spec);
    }
    Ok(Scene { name, sources })
}

/// Most channels of a source; a WAV file has the same limit.
pub(crate) const MOST_CHANNELS: usize = 1024;
/// Lowest and highest rate of a source; any other rate is taken for a mistake.
const RATES_HZ: (f64, f64) = (1e-3, 1e7);
const WEIGHTS: (f64, f64) = (1e-6, 1e3);
const SIGMAS: (f64, f64) = (1e-12, 1e12);
const OFFSETS: (f64, f64) = (0.0, 1e12);

/// Returns `value`, or an error if it is a number outside `low..=high`.
fn within(key: &str, value: Option<f64>, (low, high): (f64, f64)) -> Result<Option<f64>, String> {
    match value {
        Some(x) if !(low..=high).contains(&x) => {
            Err(format!("{key} = {x}; expected a number from {low} to {high}"))
        }
        value => Ok(value),
    }
}

impl SourceBlock {
    /// This description, with missing fields taken from `default` unless the two domains differ.
    fn over(&self, default: Option<&SourceSpec>) -> Self {
        let Some(default) = default.map(Self::of) else { return self.clone() };
        if self.domain.is_some() && self.domain != default.domain {
            return self.clone();
        }
        let table = |block: &Self| toml::Table::try_from(block).expect("a block is plain TOML");
        // Without the default rate, recordings must have a given rate only if this file gives one.
        let mut all = table(&Self { rate_hz: None, ..default });
        all.extend(table(self));
        all.try_into().expect("two blocks of sources make one")
    }

    pub(super) fn resolve(&self, id: SourceId) -> Result<SourceSpec, String> {
        let channels = match (self.channels, self.domain) {
            (Some(channels), _) => channels,
            (None, Some(DomainName::Image)) => 3,
            (None, _) => 1,
        };
        if !(1..=MOST_CHANNELS).contains(&channels) {
            return Err(format!("channels = {channels}; expected 1 to {MOST_CHANNELS}"));
        }
        let domain = self.domain_of(channels)?;
        let image = domain == Domain::Image;
        let colour = self.colour.unwrap_or_default();
        if !image && colour != Colour::default() {
            return Err("colour goes with domain = \"image\" alone".into());
        }
        let spec = SourceSpec {
            what: self.what.clone().unwrap_or_else(|| id.to_string()),
            sensor: self.sensor.clone().unwrap_or_else(|| id.to_string()),
            phase: self.phase.unwrap_or(if image { Phase::Still } else { Phase::Drag }),
            id,
            domain,
            colour,
            channels,
            rate_hz: within("rate_hz", self.rate_hz, RATES_HZ)?,
            align_mean: self.align_mean.unwrap_or(false),
            weight: within("weight", self.weight, WEIGHTS)?.unwrap_or(1.0),
            sigma: within("sigma", self.sigma, SIGMAS)?,
            score_offset: within("score_offset", self.score_offset, OFFSETS)?.unwrap_or(0.0),
        };
        spec.rate_hz.map_or(Ok(()), |rate_hz| spec.check_rate(rate_hz))?;
        Ok(spec)
    }

    fn domain_of(&self, channels: usize) -> Result<Domain, String> {
        let (_, most) = RATES_HZ;
        match (self.domain, self.band_hz) {
            (Some(DomainName::Image), Some(_)) => Err("an image has no band_hz".into()),
            (_, Some([low, high])) if !(0.0 <= low && low < high && high <= most) => {
                Err(format!("band_hz = [{low}, {high}]; expected 0 ≤ low < high ≤ {most}, in Hz"))
            }
            (Some(DomainName::Spectrum) | None, Some([low, high])) => {
                Ok(Domain::Spectrum { band_hz: (low, high) })
            }
            (Some(DomainName::Time), band_hz) => {
                Ok(Domain::Time { band_hz: band_hz.map(|[low, high]| (low, high)) })
            }
            // A source that no file describes is taken for a series in time.
            (None, None) => Ok(Domain::Time { band_hz: None }),
            (Some(DomainName::Spectrum), None) => {
                Err("a spectrum needs band_hz = [low, high], in Hz".into())
            }
            (Some(DomainName::Image), None) if channels == 3 => Ok(Domain::Image),
            (Some(DomainName::Image), None) => {
                Err(format!("an image has 3 channels, not {channels}"))
            }
        }
    }

    fn of(spec: &SourceSpec) -> Self {
        let (domain, band_hz) = match spec.domain {
            Domain::Spectrum { band_hz: (low, high) } => (DomainName::Spectrum, Some([low, high])),
            Domain::Time { band_hz } => (DomainName::Time, band_hz.map(|(low, high)| [low, high])),
            Domain::Image => (DomainName::Image, None),
        };
        let unless = |value: f64, default: f64| (value != default).then_some(value);
        Self {
            what: Some(spec.what.clone()),
            sensor: Some(spec.sensor.clone()),
            phase: Some(spec.phase),
            domain: Some(domain),
            colour: (spec.colour != Colour::default()).then_some(spec.colour),
            channels: Some(spec.channels),
            rate_hz: spec.rate_hz,
            band_hz,
            align_mean: Some(spec.align_mean),
            weight: unless(spec.weight, 1.0),
            sigma: spec.sigma,
            score_offset: unless(spec.score_offset, 0.0),
        }
    }
}
