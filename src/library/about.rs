//! `trial.toml`: surface, user, start, notes and devices of one recorded trial.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{LibraryError, files};
use crate::trial::normal;

pub(crate) const FILE: &str = "trial.toml";

/// The content of `trial.toml`. Every key is optional; unknown keys are refused.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct About {
    /// The label of the surface; if missing, the name of the surface's folder is the label.
    pub surface: Option<String>,
    pub user: Option<String>,
    /// The trial's number; if it is missing, the number at the end of the folder's name counts.
    pub trial: Option<u32>,
    /// Time at which the recording began, as a TOML date or any text.
    #[serde(deserialize_with = "date_or_text")]
    pub started_at: Option<String>,
    pub notes: Option<String>,
    /// Whether a program generated the trial, so that no sensor recorded it.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub synthetic: bool,
    /// Whether the recording was cut short, for example by a power cut; such trials are skipped.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub incomplete: bool,
    /// Times of tap and drag, written by older versions. They are kept in the file, but not used.
    pub scan: Option<toml::Table>,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub devices: BTreeMap<String, String>,
}

fn date_or_text<'de, D: serde::Deserializer<'de>>(from: D) -> Result<Option<String>, D::Error> {
    match toml::Value::deserialize(from)? {
        toml::Value::String(text) => Ok(Some(text)),
        toml::Value::Datetime(date) => Ok(Some(date.to_string())),
        other => Err(serde::de::Error::custom(format!(
            "{} is neither a date nor text; expected for example 2025-01-31T12:00:00Z",
            other.type_str()
        ))),
    }
}

impl About {
    /// Reads `trial.toml` in a trial's folder; a missing file counts as an empty one.
    ///
    /// # Errors
    /// If the file is not TOML, has an unknown key or an impossible value; the error names the line.
    pub fn read(trial: &Path) -> Result<Self, LibraryError> {
        let path = trial.join(FILE);
        match files::read_text_if_there(&path)? {
            None => Ok(Self::default()),
            Some(text) => {
                Self::from_toml(&text).map_err(|problem| LibraryError::file(&path, problem))
            }
        }
    }

    /// This content as the text of a `trial.toml`.
    pub fn to_toml(&self) -> String {
        // `About` holds only strings, numbers and tables, which TOML can express.
        toml::to_string(self).expect("what is known of a trial is plain TOML")
    }

    fn from_toml(text: &str) -> Result<Self, String> {
        let mut about: Self =
            toml::from_str(text).map_err(|error| error.to_string().trim_end().to_string())?;
        for name in [&mut about.surface, &mut about.user].into_iter().flatten() {
            *name = normal(name);
        }
        let names = [("surface", &about.surface), ("user", &about.user)];
        if let Some((key, _)) = names.iter().find(|(_, name)| name.as_deref() == Some("")) {
            return Err(format!("{key} = \"\"; write a name, or remove the line"));
        }
        Ok(about)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_known_survives_being_written() {
        let about = About {
            surface: Some("steel \"A\"\n".into()),
            user: Some("expert".into()),
            trial: Some(3),
            started_at: Some("2025-01-31T12:00:00Z".into()),
            notes: Some("pressed hard".into()),
            synthetic: true,
            incomplete: true,
            scan: Some(toml::toml! { drag_s = [0.5, 5.3] }),
            devices: BTreeMap::from([("mi2".into(), "hw:1".into())]),
        };
        assert_eq!(About::from_toml(&about.to_toml()), Ok(about));
        assert_eq!(About::from_toml(""), Ok(About::default()));
    }

    #[test]
    fn a_start_may_be_a_date_or_text() {
        let start = |text: &str| About::from_toml(text).map(|about| about.started_at.unwrap());
        assert_eq!(start("started_at = 2025-01-31T12:00:00Z").unwrap(), "2025-01-31T12:00:00Z");
        assert_eq!(start("started_at = \"noon\"").unwrap(), "noon");
        let error = start("notes = \"\"\nstarted_at = 12").unwrap_err();
        assert!(error.contains("line 2") && error.contains("neither a date"), "{error}");
    }
}
