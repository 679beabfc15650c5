//! The file `trial.toml`, which describes a recorded trial.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{LibraryError, files};
use crate::trial::{checked_session, normal};

/// Name of the file that describes a trial, in the trial's folder.
pub const ABOUT_FILE: &str = "trial.toml";

/// The content of `trial.toml`: surface, user, session, start, notes and devices of one recorded trial.
/// Every key is optional; unknown keys are refused, except in the table `[meta]`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct About {
    /// The label of the surface; if missing, the name of the surface's folder is the label.
    pub surface: Option<String>,
    pub user: Option<String>,
    /// The trial's number; if it is missing, the number at the end of the folder's name counts.
    pub trial: Option<u32>,
    /// The sitting: the same person, sensor, place and day.
    pub session: Option<String>,
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
    /// Frames that `import csv` filled in, by source: their count, and which they are.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub interpolated: BTreeMap<String, String>,
    /// Keys of one's own, such as a force or a tool: text, numbers and truth values, to choose trials by.
    #[serde(skip_serializing_if = "toml::Table::is_empty")]
    pub meta: toml::Table,
}

/// Keys of `trial.toml` that a trial is chosen by, which `[meta]` may not hold as well.
const NOT_META: [&str; 6] = ["surface", "user", "trial", "session", "synthetic", "incomplete"];

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
        let path = trial.join(ABOUT_FILE);
        let Some(text) = files::read_text_if_there(&path)? else { return Ok(Self::default()) };
        Self::from_toml(&text).map_err(LibraryError::at(&path))
    }

    pub fn to_toml(&self) -> String {
        // `About` holds only strings, numbers and tables, which TOML can express.
        toml::to_string(self).expect("what is known of a trial is plain TOML")
    }

    fn from_toml(text: &str) -> Result<Self, String> {
        let mut about: Self = toml::from_str(text).map_err(|error| {
            let advice = match error.message().starts_with("unknown field") {
                true => "\nput keys of your own under a line `[meta]`, at the end of the file",
                false => "",
            };
            format!("{}{advice}", error.to_string().trim_end())
        })?;
        for name in [&mut about.surface, &mut about.user].into_iter().flatten() {
            *name = normal(name);
        }
        let names = [("surface", &about.surface), ("user", &about.user)];
        if let Some((key, _)) = names.iter().find(|(_, name)| name.as_deref() == Some("")) {
            return Err(format!("{key} = \"\"; write a name, or remove the line"));
        }
        about.session = (about.session.as_deref().map(checked_session).transpose())
            .map_err(|problem| format!("session {problem}"))?;
        about.meta.iter().try_for_each(|(key, value)| check_meta(key, value))?;
        Ok(about)
    }
}

/// Refuses a key of `[meta]` that would be overlooked, or that no condition can compare.
fn check_meta(key: &str, value: &toml::Value) -> Result<(), String> {
    if NOT_META.contains(&key) {
        return Err(format!("{key} stands under [meta]; move it above the line `[meta]`"));
    }
    match value {
        toml::Value::String(_)
        | toml::Value::Integer(_)
        | toml::Value::Float(_)
        | toml::Value::Boolean(_) => Ok(()),
        other => Err(format!(
            "{key} under [meta] is of the type {}; expected text in quotes, a number, true or false",
            other.type_str()
        )),
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
            session: Some("monday".into()),
            started_at: Some("2025-01-31T12:00:00Z".into()),
            notes: Some("pressed hard".into()),
            synthetic: true,
            incomplete: true,
            scan: Some(toml::toml! { drag_s = [0.5, 5.3] }),
            devices: BTreeMap::from([("mi2".into(), "hw:1".into())]),
            interpolated: BTreeMap::from([("acc".into(), "2 of 100: 7-8".into())]),
            meta: toml::toml! { force_n = 1.5
            passes = 3
            tool = "steel tip"
            wet = false },
        };
        assert_eq!(About::from_toml(&about.to_toml()), Ok(about));
        assert_eq!(About::from_toml(""), Ok(About::default()));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (text, parts) in [
            ("user = \"anna\"\nforce_n = 2\n", &["line 2", "force_n", "`[meta]`"][..]),
            ("[meta]\nuser = \"anna\"", &["above the line"]),
            ("[meta]\nforces = [1, 2]", &["type array"]),
            ("[meta]\nat = 2026-01-31", &["type datetime"]),
            ("session = \"\"", &["session is empty"]),
            ("notes = \"\"\nstarted_at = 12", &["line 2", "neither a date"]),
        ] {
            let error = About::from_toml(text).unwrap_err();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
        let session = About::from_toml("session = \"a/b\"").unwrap_err();
        assert!(session.starts_with("session holds '/'"), "{session}");
        let other = About::from_toml("trial = \"x\"").unwrap_err();
        assert!(!other.contains("[meta]"), "{other}");
    }

    #[test]
    fn a_session_may_be_a_moment_and_a_start_a_date_or_text() {
        let session = |text: &str| About::from_toml(text).unwrap().session.unwrap();
        assert_eq!(session("session = \" day 2 \""), "day 2");
        assert_eq!(session("session = \"2026-11-25T10:42\""), "2026-11-25T10:42");
        let start = |text: &str| About::from_toml(text).unwrap().started_at.unwrap();
        assert_eq!(start("started_at = 2025-01-31T12:00:00Z"), "2025-01-31T12:00:00Z");
        assert_eq!(start("started_at = \"noon\""), "noon");
    }
}
