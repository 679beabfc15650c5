//! The TOML form of a scene: what was said, checked, and turned into [`Scene`].

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{Colour, Domain, Phase, Scene, SourceId, SourceSpec};

/// Why a description of sources cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// not TOML, an unknown key, a missing one, a wrong type
    #[error("{0}")]
    Toml(#[from] toml::de::Error),
    /// a format of the future
    #[error("line {line}: format = {found}, but this program reads format 1; update surfaced")]
    Format {
        /// line, counted from 1
        line: usize,
        /// what the file says
        found: u32,
    },
    /// a source that cannot be
    #[error("line {line}: source `{source_name}`: {problem}")]
    Source {
        /// line of the source's table, counted from 1
        line: usize,
        /// its name
        source_name: String,
        /// what is wrong, and what was expected
        problem: String,
    },
    /// a name that cannot name a file
    #[error("`{0}` cannot name a source; use letters, digits, `_` and `-`")]
    SourceName(String),
    /// a source that the scene does not have
    #[error("no source is called `{name}`; there are: {known}")]
    UnknownSource {
        /// what was asked for
        name: String,
        /// what there is
        known: String,
    },
}

/// What a file said.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneFile {
    format: toml::Spanned<u32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    /// Text for whoever opens the file; carries no meaning for the program.
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

/// What a file said of one source.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SourceBlock {
    #[serde(skip_serializing_if = "Option::is_none")]
    what: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sensor: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    phase: Option<Phase>,
    domain: DomainName,
    #[serde(default, skip_serializing_if = "is_default_colour")]
    colour: Colour,
    #[serde(default = "one_channel")]
    channels: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    rate_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    band_hz: Option<[f64; 2]>,
    #[serde(default)]
    align_mean: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    weight: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    score_offset: Option<f64>,
}

fn is_default_colour(colour: &Colour) -> bool {
    *colour == Colour::default()
}

fn one_channel() -> usize {
    1
}

pub(super) fn parse(text: &str) -> Result<Scene, SceneError> {
    parse_library(text).map(|(scene, _)| scene)
}

/// The scene, and whether the file carries the mark `synthetic`.
pub(super) fn parse_library(text: &str) -> Result<(Scene, bool), SceneError> {
    let file: SceneFile = toml::from_str(text)?;
    let line_of = |at: usize| text[..at].lines().count().max(1);
    if *file.format.get_ref() != 1 {
        let line = line_of(file.format.span().end);
        return Err(SceneError::Format { line, found: *file.format.get_ref() });
    }
    let scene = scene(file.name.unwrap_or_default(), file.sources, text)?;
    Ok((scene, file.synthetic))
}

/// A scene of what a file with this `text` said of each source.
pub(crate) fn scene(
    name: String,
    blocks: BTreeMap<String, toml::Spanned<SourceBlock>>,
    text: &str,
) -> Result<Scene, SceneError> {
    let line_of = |at: usize| text[..at].lines().count().max(1);
    let mut sources = BTreeMap::new();
    for (name, block) in blocks {
        let line = line_of(block.span().end.min(text.len()));
        let fail = |problem: String| SceneError::Source {
            line: line_of(block.span().start + 1).min(line),
            source_name: name.clone(),
            problem,
        };
        let id = SourceId::new(&name).map_err(|error| fail(error.to_string()))?;
        let spec = block.get_ref().resolve(id.clone()).map_err(fail)?;
        sources.insert(id, spec);
    }
    Ok(Scene { name, sources })
}

impl SourceBlock {
    fn resolve(&self, id: SourceId) -> Result<SourceSpec, String> {
        let positive = |what: &str, value: Option<f64>| match value {
            Some(x) if !(x.is_finite() && x > 0.0) => {
                Err(format!("{what} = {x}; expected a positive number"))
            }
            other => Ok(other),
        };
        if self.channels == 0 {
            return Err("channels = 0; expected at least 1".into());
        }
        let domain = match (self.domain, self.band_hz) {
            (DomainName::Spectrum, Some([low, high]))
                if 0.0 <= low && low < high && high.is_finite() =>
            {
                Domain::Spectrum { band_hz: (low, high) }
            }
            (DomainName::Spectrum, Some([low, high])) => {
                return Err(format!("band_hz = [{low}, {high}]; expected 0 ≤ low < high, in Hz"));
            }
            (DomainName::Spectrum, None) => {
                return Err("a spectrum needs band_hz = [low, high], in Hz".into());
            }
            (_, Some(_)) => return Err("band_hz goes with domain = \"spectrum\" alone".into()),
            (DomainName::Time, None) => Domain::Time,
            (DomainName::Image, None) if self.channels == 3 => Domain::Image,
            (DomainName::Image, None) => {
                return Err(format!("an image has 3 channels, not {}", self.channels));
            }
        };
        let image = domain == Domain::Image;
        if !image && !is_default_colour(&self.colour) {
            return Err("colour goes with domain = \"image\" alone".into());
        }
        Ok(SourceSpec {
            what: self.what.clone().unwrap_or_else(|| id.to_string()),
            sensor: self.sensor.clone().unwrap_or_else(|| id.to_string()),
            phase: self.phase.unwrap_or(if image { Phase::Still } else { Phase::Drag }),
            id,
            domain,
            colour: self.colour,
            channels: self.channels,
            rate_hz: positive("rate_hz", self.rate_hz)?,
            align_mean: self.align_mean,
            weight: positive("weight", self.weight)?.unwrap_or(1.0),
            sigma: positive("sigma", self.sigma)?,
            score_offset: match self.score_offset.unwrap_or(0.0) {
                x if x.is_finite() && x >= 0.0 => x,
                x => return Err(format!("score_offset = {x}; expected 0 or more")),
            },
        })
    }

    fn from_spec(spec: &SourceSpec) -> Self {
        let (domain, band_hz) = match spec.domain {
            Domain::Spectrum { band_hz: (low, high) } => (DomainName::Spectrum, Some([low, high])),
            Domain::Time => (DomainName::Time, None),
            Domain::Image => (DomainName::Image, None),
        };
        let unless = |value: f64, default: f64| (value != default).then_some(value);
        Self {
            what: Some(spec.what.clone()),
            sensor: Some(spec.sensor.clone()),
            phase: Some(spec.phase),
            domain,
            colour: spec.colour,
            channels: spec.channels,
            rate_hz: spec.rate_hz,
            band_hz,
            align_mean: spec.align_mean,
            weight: unless(spec.weight, 1.0),
            sigma: spec.sigma,
            score_offset: unless(spec.score_offset, 0.0),
        }
    }
}

pub(super) fn write(scene: &Scene, synthetic: bool) -> String {
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
        assert_eq!(Scene::from_toml(&scene.to_toml()).unwrap(), scene);
    }

    #[test]
    fn an_unknown_key_is_refused_with_its_line() {
        let text = "format = 1\n[sources.pac]\ndomain = \"time\"\nalign = true\n";
        let error = Scene::from_toml(text).unwrap_err().to_string();
        assert!(error.contains("line 4") && error.contains("align"), "{error}");
    }

    #[test]
    fn an_impossible_band_is_refused_with_its_line() {
        let text = "format = 1\n[sources.pac]\ndomain = \"spectrum\"\nband_hz = [9, 1]\n";
        let error = Scene::from_toml(text).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("low < high"), "{error}");
    }
}
