//! Checks of a configuration's values, with a message for each mistake.

use std::collections::BTreeMap;
use std::ops::Range;

use toml::Spanned;

use super::file::is_default;
use crate::scene::{Scene, SourceId};

pub(super) struct Mistake {
    pub at: Range<usize>,
    pub problem: String,
}

pub(super) fn mistake<T, S>(at: &Spanned<S>, problem: impl Into<String>) -> Result<T, Mistake> {
    Err(Mistake { at: at.span(), problem: problem.into() })
}

pub(super) fn parsed<T: std::str::FromStr<Err = String>>(
    key: &str,
    value: &Spanned<String>,
) -> Result<T, Mistake> {
    value.get_ref().parse().or_else(|problem| mistake(value, format!("{key}: {problem}")))
}

/// Checks that a value is finite and above 0.
pub(super) fn positive<T>(key: &str, value: &Spanned<T>) -> Result<T, Mistake>
where
    T: Copy + Default + PartialOrd + std::fmt::Display + std::ops::Mul<Output = T>,
{
    let number = *value.get_ref();
    // Infinity times 0 is NaN, and so not equal to 0.
    let finite = number * T::default() == T::default();
    match number > T::default() && finite {
        true => Ok(number),
        false => mistake(value, format!("{key} = {number}; expected more than 0")),
    }
}

/// The source of the scene called `name`. A mistake is reported at the place `at`.
pub(super) fn known<S>(name: &str, at: &Spanned<S>, scene: &Scene) -> Result<SourceId, Mistake> {
    if let Some(spec) = scene.get(name) {
        return Ok(spec.id.clone());
    }
    let known: Vec<_> = scene.sources().map(|spec| spec.id.as_str()).collect();
    let problem = format!(
        "no source is called `{name}`; there are {}; describe others in [sources.{name}]",
        known.join(", ")
    );
    mistake(at, problem)
}

/// The source called `name`, if it has one channel for each of `parts`; messages call these `what`.
pub(super) fn source_of<T>(
    name: &str,
    what: &str,
    parts: &Spanned<Vec<T>>,
    scene: &Scene,
) -> Result<SourceId, Mistake> {
    let id = known(name, parts, scene)?;
    let expected = scene.get(name).map_or(0, |spec| spec.channels);
    match parts.get_ref().len() {
        found if found == expected => Ok(id),
        found => {
            let problem = format!("{name}: {what}: {found}, but the source has {expected}");
            mistake(parts, problem)
        }
    }
}

/// Refuses settings for sources that `sources` lacks, except default settings.
pub(super) fn no_stray<T, S>(
    settings: &BTreeMap<String, Spanned<T>>,
    sources: &BTreeMap<String, S>,
    table: &str,
) -> Result<(), Mistake> {
    let mut own = settings.iter().filter(|(_, value)| !is_default(*value));
    match own.find(|(name, _)| !sources.contains_key(*name)) {
        Some((name, value)) => mistake(value, format!("`{name}` is no source of {table}")),
        None => Ok(()),
    }
}
