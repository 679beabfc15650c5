//! The bodies of requests to enrol.

use axum::body::Bytes;
use serde::Deserialize;

use super::label;
use crate::station::Command;
use crate::trial::EXPERT;

/// Most trials of one enrolment.
const MOST_TRIALS: u32 = 1000;

/// The body of a request to keep a refused scan.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct KeepRefused {
    scan: u32,
}

/// The command in the body of a request to keep a refused scan.
///
/// # Errors
/// If it is not valid, with the reason.
pub fn keep_refused(body: &Bytes) -> Result<Command, String> {
    let read = serde_json::from_slice(body);
    let KeepRefused { scan } =
        read.map_err(|error| format!("{error}; expected {{\"scan\": 7}}"))?;
    Ok(Command::KeepRefused(scan))
}

/// The body of a request to enrol.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Enroll {
    surface: String,
    user: Option<String>,
    #[serde(default = "one")]
    trials: u32,
}

fn one() -> u32 {
    1
}

/// The command in the body of a request to enrol.
///
/// # Errors
/// If it is not valid, with the reason.
pub fn enroll(body: &Bytes) -> Result<Command, String> {
    let Enroll { surface, user, trials } = serde_json::from_slice(body).map_err(|error| {
        format!("{error}; expected {{\"surface\": \"oak\", \"user\": \"anna\", \"trials\": 3}}")
    })?;
    let surface = label::check("surface", &surface)?;
    let user = label::check("user", user.as_deref().unwrap_or(EXPERT))?;
    if !(1..=MOST_TRIALS).contains(&trials) {
        return Err(format!("`trials` is {trials}; expected 1 to {MOST_TRIALS}"));
    }
    Ok(Command::Enroll { surface, user, trials })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn of(body: &str) -> Result<Command, String> {
        enroll(&Bytes::copy_from_slice(body.as_bytes()))
    }

    #[test]
    fn an_enrolment_needs_a_surface_alone() {
        let order = of(r#"{"surface": " oak "}"#).unwrap();
        let expected = Command::Enroll { surface: "oak".into(), user: EXPERT.into(), trials: 1 };
        assert_eq!(order, expected);
        let order = of(r#"{"surface": "oak", "user": "anna", "trials": 3}"#).unwrap();
        let expected = Command::Enroll { surface: "oak".into(), user: "anna".into(), trials: 3 };
        assert_eq!(order, expected);
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (body, part) in [
            ("", "expected"),
            ("[]", "expected"),
            (r#"{"surface": "oak", "path": "/etc"}"#, "`path`"),
            (r#"{"surface": "../../etc/passwd"}"#, "`surface`"),
            (r#"{"surface": "<img onerror=alert(1)>"}"#, "`surface`"),
            (r#"{"surface": "oak", "user": "a/b"}"#, "`user`"),
            (r#"{"surface": "oak", "trials": 0}"#, "`trials`"),
            (r#"{"surface": "oak", "trials": -1}"#, "-1"),
            (r#"{"surface": "oak", "trials": 1e9}"#, "expected"),
        ] {
            let said = of(body).unwrap_err();
            assert!(said.contains(part), "{body}: {said}");
        }
    }

    proptest! {
        #[test]
        fn no_body_panics_and_no_label_that_passes_can_mean_a_path(
            bytes in proptest::collection::vec(any::<u8>(), 0..200),
            label in "\\PC{0,90}|[./\\\\a]{1,9}",
        ) {
            let _ = enroll(&Bytes::from(bytes));
            let body = serde_json::json!({ "surface": label }).to_string();
            if let Ok(Command::Enroll { surface, .. }) = of(&body) {
                prop_assert!(!surface.starts_with('.') && !surface.contains(['/', '\\', '\0', '<']));
            }
        }
    }
}
