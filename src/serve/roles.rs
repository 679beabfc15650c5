//! The role of a client, what it may do, and the name of the person who sends a request.

use axum::Extension;
use axum::http::{HeaderMap, Method};
use axum::response::Json;
use serde_json::{Value, json};

use super::request::{Problem, Reply};
use crate::history::Actor;
use crate::station::config::percent_decoded;

/// The header with the name of the person, as percent-encoded UTF-8.
const PERSON: &str = "x-surfaced-person";
/// Longest name of a person, in characters.
const LONGEST_NAME: usize = 64;

/// Whether an operator may send a request. Of the paths that change something, only those named here
/// are open to operators.
pub(super) fn may_operator(method: &Method, path: &str) -> bool {
    match path.strip_prefix("/api/v1/").unwrap_or_default() {
        "audit" | "audit.jsonl" => false,
        "start" | "stop" | "scans/correct" => true,
        _ if method == Method::GET || method == Method::HEAD => true,
        path => {
            let id = path.strip_prefix("scans/").and_then(|rest| rest.strip_suffix("/correct"));
            id.is_some_and(|id| !id.contains('/'))
        }
    }
}

/// The name of the person who sends a request; `None` if the request names nobody.
pub(super) fn person(headers: &HeaderMap) -> Reply<Option<String>> {
    let Some(value) = headers.get(PERSON) else { return Ok(None) };
    let bad = |why: String| Problem::Bad(format!("`X-Surfaced-Person` {why}"));
    let name = value.to_str().ok().and_then(percent_decoded).ok_or_else(|| {
        bad("is not percent-encoded UTF-8; write `J%C3%BCrgen` for `Jürgen`".into())
    })?;
    let name = name.trim();
    match name.chars().count() {
        0 => Ok(None),
        n if n > LONGEST_NAME => {
            Err(bad(format!("has {n} characters; expected at most {LONGEST_NAME}")))
        }
        _ if name.contains(char::is_control) => {
            Err(bad(format!("holds a control character: {name:?}; give a name alone")))
        }
        _ => Ok(Some(name.into())),
    }
}

/// Who sends a request, as axum passes it to the handlers. The guard has found out.
pub(super) type By = Extension<Actor>;

pub(super) async fn me(Extension(actor): By) -> Json<Value> {
    Json(json!({ "role": actor.role }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_operator_may_send_nothing_to_a_path_that_is_not_named() {
        let may = |method: Method, path: &str| may_operator(&method, &format!("/api/v1/{path}"));
        for path in ["scans/a/b/correct", "library/correct", "anything/new", "audit", "check"] {
            assert!(!may(Method::POST, path), "{path}");
        }
        assert!(may(Method::HEAD, "check") && !may(Method::HEAD, "audit.jsonl"));
        assert!(!may_operator(&Method::POST, "/metrics"));
    }

    #[test]
    fn a_person_is_a_short_name_that_is_percent_encoded() {
        let of = |value: &str| {
            let headers = HeaderMap::from_iter([(
                PERSON.parse().unwrap(),
                axum::http::HeaderValue::from_bytes(value.as_bytes()).unwrap(),
            )]);
            person(&headers).map_err(|problem| problem.to_string())
        };
        assert_eq!(person(&HeaderMap::new()).unwrap(), None);
        for (value, name) in [
            ("anna", Some("anna")),
            ("J%C3%BCrgen%20M.", Some("Jürgen M.")),
            (" anna ", Some("anna")),
            ("%20", None),
            ("", None),
        ] {
            assert_eq!(of(value).unwrap().as_deref(), name, "{value}");
        }
        assert_eq!(of(&"%C3%A9".repeat(64)).unwrap(), Some("é".repeat(64)));
        for (value, why) in [
            ("%C3%A9".repeat(65), "has 65 characters; expected at most 64"),
            ("a%0Ab".into(), "holds a control character"),
            ("%FF".into(), "is not percent-encoded UTF-8"),
            ("50%".into(), "is not percent-encoded UTF-8"),
            ("Jürgen".into(), "is not percent-encoded UTF-8"),
        ] {
            assert!(of(&value).unwrap_err().contains(why), "{value}");
        }
    }
}
