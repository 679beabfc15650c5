//! The TOML form of a scene: what was said, checked, and turned into [`Scene`].

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{Colour, Domain, Phase, Scene, SceneError, SourceId, SourceSpec};

/// A file as it stands.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneFile {
    format: toml::Spanned<u32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    /// A text for readers of the file, which the program ignores.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    notes: Option<String>,
    /// A library that was made by a generator says so.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    synthetic: bool,
    #[serde(default)]
    sources: BTreeMap<String, toml::Spanned<SourceBlock>>,
}

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum DomainName {
    Spectrum,
    Time,
    Image,
}

/// One source as a file describes it.
#[derive(Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SourceBlock {
    #[serde(skip_serializing_if = "Option::is_none")]
    what: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sensor: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    phase: Option<Phase>,
    #[serde(skip_serializing_if = "Option::is_none")]
    domain: Option<DomainName>,
    #[serde(skip_serializing_if = "Option::is_none")]
    colour: Option<Colour>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub channels: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rate_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    band_hz: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    align_mean: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    weight: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    score_offset: Option<f64>,
}

impl Scene {
    /// The eight sources of LMT108.
    pub fn lmt108() -> Self {
        // A test parses the embedded file.
        parse(include_str!("../../configs/lmt108.toml")).expect("the embedded scene parses")
    }

    /// A scene from the text of a TOML file (`configs/lmt108.toml` shows the form).
    ///
    /// # Errors
    /// With line and column, if the text is not TOML, has an unknown key, or describes an
    /// impossible source.
    pub fn from_toml(text: &str) -> Result<Self, SceneError> {
        parse(text)
    }

    /// The scene as the `library.toml` of a library, in the form that
    /// [`LibraryToml::parse`] reads.
    pub fn to_library_toml(&self, synthetic: bool) -> String {
        write(self, synthetic)
    }
}

/// The line of a TOML text that the byte `at` lies in, counted from 1.
pub(crate) fn line_of(text: &str, at: usize) -> usize {
    1 + text.bytes().take(at).filter(|byte| *byte == b'\n').count()
}

/// The settings of one source in a `library.toml`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Declared {
    /// The rate in Hz that recordings must have.
    pub rate_hz: Option<f64>,
    /// Whether it gives a band.
    pub band: bool,
    /// Whether it gives a number of channels.
    pub channels: bool,
}

/// The content of a `library.toml`.
#[derive(Clone, Debug, PartialEq)]
pub struct LibraryToml {
    /// The sources that it describes, and the library's name.
    pub sources: Scene,
    /// Its own settings for each of them, which go before the defaults.
    pub declared: BTreeMap<SourceId, Declared>,
    /// Whether it carries `synthetic = true`.
    pub synthetic: bool,
}

impl LibraryToml {
    /// Parses the file's text. A source that `defaults` know needs only what differs from them;
    /// one that is of another domain than theirs is described anew.
    ///
    /// # Errors
    /// As [`Scene::from_toml`].
    pub fn parse(text: &str, defaults: &Scene) -> Result<Self, SceneError> {
        let file = SceneFile::parse(text)?;
        let declared = |(name, block): (&String, &toml::Spanned<SourceBlock>)| {
            let SourceBlock { rate_hz, band_hz, channels, .. } = *block.get_ref();
            let (band, channels) = (band_hz.is_some(), channels.is_some());
            Some((SourceId::new(name).ok()?, Declared { rate_hz, band, channels }))
        };
        let declared = file.sources.iter().filter_map(declared).collect();
        let sources = scene(file.name.unwrap_or_default(), file.sources, text, Some(defaults))?;
        Ok(Self { sources, declared, synthetic: file.synthetic })
    }
}

impl SceneFile {
    fn parse(text: &str) -> Result<Self, SceneError> {
        let file: Self = toml::from_str(text)?;
        match *file.format.get_ref() {
            1 => Ok(file),
            found => {
                let line = line_of(text, file.format.span().start);
                Err(SceneError::Format { line, found })
            }
        }
    }
}

fn parse(text: &str) -> Result<Scene, SceneError> {
    let file = SceneFile::parse(text)?;
    scene(file.name.unwrap_or_default(), file.sources, text, None)
}

/// A scene of what a file with this `text` said of each source; what it does not say of one that
/// `defaults` know is as they have it.
pub(crate) fn scene(
    name: String,
    blocks: BTreeMap<String, toml::Spanned<SourceBlock>>,
    text: &str,
    defaults: Option<&Scene>,
) -> Result<Scene, SceneError> {
    let mut sources = BTreeMap::new();
    for (name, block) in blocks {
        let fail = |problem: String| SceneError::Source {
            line: line_of(text, block.span().start),
            source_name: name.clone(),
            problem,
        };
        let id = SourceId::new(&name).map_err(|error| fail(error.to_string()))?;
        let default = defaults.and_then(|scene| scene.get(id.as_str()));
        let spec = block.get_ref().over(default).resolve(id.clone()).map_err(fail)?;
        sources.insert(id, spec);
    }
    Ok(Scene { name, sources })
}

/// Most channels of a source, as of a WAV file.
const MOST_CHANNELS: usize = 1024;
/// Least and greatest rate of a source; what lies outside is a slip, and could not be worked with.
const RATES_HZ: (f64, f64) = (1e-3, 1e7);
const WEIGHTS: (f64, f64) = (1e-6, 1e3);
const SIGMAS: (f64, f64) = (1e-12, 1e12);
const OFFSETS: (f64, f64) = (0.0, 1e12);

/// A number, if it lies between two others, both included.
fn within(key: &str, value: Option<f64>, (low, high): (f64, f64)) -> Result<Option<f64>, String> {
    match value {
        Some(x) if !(low..=high).contains(&x) => {
            Err(format!("{key} = {x}; expected a number from {low} to {high}"))
        }
        value => Ok(value),
    }
}

impl SourceBlock {
    /// This description, with missing fields taken from `default` if both have the same domain.
    fn over(&self, default: Option<&SourceSpec>) -> Self {
        let Some(default) = default.map(Self::from_spec) else { return self.clone() };
        if self.domain.is_some() && self.domain != default.domain {
            return self.clone();
        }
        let own = self.clone();
        Self {
            what: own.what.or(default.what),
            sensor: own.sensor.or(default.sensor),
            phase: own.phase.or(default.phase),
            domain: default.domain,
            colour: own.colour.or(default.colour),
            channels: own.channels.or(default.channels),
            // A rate is asked for only where somebody says so.
            rate_hz: own.rate_hz,
            band_hz: own.band_hz.or(default.band_hz),
            align_mean: own.align_mean.or(default.align_mean),
            weight: own.weight.or(default.weight),
            sigma: own.sigma.or(default.sigma),
            score_offset: own.score_offset.or(default.score_offset),
        }
    }

    fn resolve(&self, id: SourceId) -> Result<SourceSpec, String> {
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
        match (self.domain, self.band_hz) {
            (Some(DomainName::Image), Some(_)) => Err("an image has no band_hz".into()),
            (_, Some([low, high])) if !(0.0 <= low && low < high && high <= RATES_HZ.1) => {
                Err(format!(
                    "band_hz = [{low}, {high}]; expected 0 ≤ low < high ≤ {}, in Hz",
                    RATES_HZ.1
                ))
            }
            (Some(DomainName::Spectrum) | None, Some([low, high])) => {
                Ok(Domain::Spectrum { band_hz: (low, high) })
            }
            (Some(DomainName::Time), band_hz) => {
                Ok(Domain::Time { band_hz: band_hz.map(|[low, high]| (low, high)) })
            }
            // A source that no table knows needs no more than its name.
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

    fn from_spec(spec: &SourceSpec) -> Self {
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

fn write(scene: &Scene, synthetic: bool) -> String {
    let spanned = |block| toml::Spanned::new(0..0, block);
    let file = SceneFile {
        format: toml::Spanned::new(0..0, 1),
        name: (!scene.name.is_empty()).then(|| scene.name.clone()),
        notes: None,
        synthetic,
        sources: scene
            .sources()
            .map(|spec| (spec.id.to_string(), spanned(SourceBlock::from_spec(spec))))
            .collect(),
    };
    // Plain strings, numbers and tables: nothing here that TOML cannot express.
    toml::to_string(&file).expect("a scene is plain TOML")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_embedded_scene_holds_the_eight_sources() {
        let scene = Scene::lmt108();
        let names: Vec<_> = scene.sources().map(|s| s.id.as_str()).collect();
        assert_eq!(names, ["ac", "ca1", "ca2", "fr", "ir", "me", "mi1", "mi2"]);
        assert_eq!(scene.get("me").unwrap().sigma, Some(1.0));
    }

    #[test]
    fn a_scene_survives_being_written() {
        let scene = Scene::lmt108();
        assert_eq!(parse(&scene.to_library_toml(false)).unwrap(), scene);
    }

    #[test]
    fn an_unknown_key_is_refused_with_its_line() {
        let text = "format = 1\n[sources.pac]\ndomain = \"time\"\nalign = true\n";
        let error = parse(text).unwrap_err().to_string();
        assert!(error.contains("line 4") && error.contains("align"), "{error}");
    }

    #[test]
    fn an_impossible_band_is_refused_with_its_line() {
        let text = "format = 1\n[sources.pac]\ndomain = \"spectrum\"\nband_hz = [9, 1]\n";
        let error = parse(text).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("low < high"), "{error}");
    }

    #[test]
    fn numbers_that_nothing_could_work_with_are_refused() {
        for (line, part) in [
            ("rate_hz = 1e300", "rate_hz"),
            ("rate_hz = 0", "rate_hz"),
            ("rate_hz = nan", "rate_hz"),
            ("channels = 0", "channels"),
            ("channels = 1000000000000", "channels"),
            ("weight = 1e300", "weight"),
            ("weight = -1", "weight"),
            ("sigma = 1e-300", "sigma"),
            ("score_offset = inf", "score_offset"),
        ] {
            let text = format!("format = 1\n\n[sources.pac]\ndomain = \"time\"\n{line}\n");
            let error = parse(&text).unwrap_err().to_string();
            assert!(error.contains("line 3") && error.contains(part), "{line}: {error}");
        }
    }

    #[test]
    fn a_source_that_the_defaults_know_needs_only_what_differs() {
        let of = |lines: &str, name: &str| {
            let text = format!("format = 1\n[sources.{name}]\n{lines}\n");
            let parsed = LibraryToml::parse(&text, &Scene::lmt108());
            parsed.map(|library| library.sources.get(name).unwrap().clone())
        };
        let default = |name: &str| Scene::lmt108().get(name).unwrap().clone();
        let stereo = of("channels = 2", "mi2").unwrap();
        assert_eq!(stereo, SourceSpec { channels: 2, rate_hz: None, ..default("mi2") });
        let band = of("band_hz = [50, 5000]", "mi2").unwrap();
        assert_eq!(band.domain, Domain::Spectrum { band_hz: (50.0, 5000.0) });
        assert!(band.align_mean && band.what == "sound while dragging");
        let anew = of("domain = \"time\"", "mi2").unwrap();
        assert!(
            !anew.align_mean && anew.domain == Domain::Time { band_hz: None },
            "another domain is another source"
        );
        let unknown = of("channels = 2", "pac").unwrap();
        assert_eq!((unknown.domain, unknown.channels), (Domain::Time { band_hz: None }, 2));
        assert_eq!(of("domain = \"image\"", "top").unwrap().channels, 3);
    }

    #[test]
    fn a_band_above_half_the_rate_is_refused() {
        let text = "format = 1\n[sources.pac]\ndomain = \"spectrum\"\nband_hz = [1500, 3000]\n";
        let scene = parse(text).unwrap();
        let spec = scene.get("pac").unwrap();
        assert!(spec.check_rate(6000.0).is_ok());
        assert!(spec.check_rate(2000.0).unwrap_err().contains("lower its upper end to 1000"));
        let error = parse(&format!("{text}rate_hz = 2000\n")).unwrap_err().to_string();
        assert!(error.contains("above half"), "{error}");
    }
}
