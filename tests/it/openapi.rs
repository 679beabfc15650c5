//! The OpenAPI document describes the paths that the router has, and no others.

use std::collections::BTreeSet;
use std::fmt::Write;

use crate::common::http::serve;
use serde_json::Value;

/// The routes below `/api/v1`, as the source says: (method, path).
fn routes() -> BTreeSet<(String, String)> {
    let sources = [
        include_str!("../../src/serve/api.rs"),
        include_str!("../../src/serve/scans.rs"),
        include_str!("../../src/serve/review.rs"),
        include_str!("../../src/serve/library.rs"),
    ];
    let mut routes: BTreeSet<(String, String)> = BTreeSet::new();
    for source in sources {
        for part in source.split(".route(").skip(1) {
            let path = part.trim_start().strip_prefix('"').unwrap_or("").split('"').next().unwrap();
            // Up to the next route, or the end of the list.
            let list = part.split(".merge(").next().unwrap().split("\n}").next().unwrap();
            for method in ["get", "post"] {
                if list.contains(&format!("{method}(")) {
                    routes.insert((method.into(), path.into()));
                }
            }
        }
    }
    routes.retain(|(_, path)| {
        path.starts_with('/') && !["/metrics", "/healthz", "/readyz"].contains(&path.as_str())
    });
    routes
}

#[test]
fn the_open_api_document_is_what_the_router_has() {
    let served = serve(|_| {});
    let document: Value = served.get("/api/v1/openapi.json").json();
    let mut described = BTreeSet::new();
    for (path, methods) in document["paths"].as_object().unwrap() {
        for (method, operation) in methods.as_object().unwrap() {
            described.insert((method.clone(), path.clone()));
            assert!(operation["summary"].is_string(), "{method} {path}");
            let real = format!("/api/v1{}", path.replace("{id}", "1").replace("{file}", "ac.wav"));
            let reply = match method.as_str() {
                // A stream without an end.
                _ if path == "/events" => continue,
                "get" => served.get(&real),
                _ => served.post(&real, "{}"),
            };
            assert_ne!(reply.status, 405, "{method} {path}");
            let nothing = reply.status == 404 && !path.contains('{');
            assert!(!nothing, "{method} {path}: {}", reply.body);
        }
    }
    assert_eq!(described, routes());
}

/// The variants of an enum in a source, in the form of JSON.
fn variants(source: &str, of: &str) -> BTreeSet<String> {
    let body = source.split_once(of).unwrap().1.split_once("\n}").unwrap().0;
    let names = body.lines().filter_map(|line| {
        let line = line.strip_prefix("    ").filter(|line| line.starts_with(char::is_uppercase))?;
        Some(line.split([',', ' ', '(']).next().unwrap())
    });
    let snake = |name: &str| {
        name.chars().fold(String::new(), |mut text, letter| {
            let gap = if letter.is_uppercase() && !text.is_empty() { "_" } else { "" };
            write!(text, "{gap}{}", letter.to_lowercase()).unwrap();
            text
        })
    };
    names.map(snake).collect()
}

#[test]
fn each_doubt_warning_and_refusal_has_its_row_among_the_remedies() {
    let document: Value =
        serde_json::from_str(include_str!("../../src/serve/openapi.json")).unwrap();
    let schemas = &document["components"]["schemas"];
    let listed = |schema: &str, field: &str| -> BTreeSet<String> {
        let words = schemas[schema]["properties"][field]["enum"].as_array().unwrap();
        words.iter().map(|word| word.as_str().unwrap().into()).collect()
    };
    let doubts = variants(include_str!("../../src/method/trial/doubt.rs"), "pub enum Doubt {");
    assert_eq!(listed("Doubt", "kind"), doubts);
    let warnings =
        variants(include_str!("../../src/station/device/mod.rs"), "pub enum WarningKind {");
    assert_eq!(listed("Warning", "kind"), warnings);
    let problems = include_str!("../../src/serve/request.rs").split_once("fn kind(").unwrap().1;
    let problems = problems.split_once("\n    }\n").unwrap().0;
    let problems: BTreeSet<String> =
        problems.split('"').skip(1).step_by(2).map(String::from).collect();
    assert_eq!(listed("Problem", "error"), problems);

    let page = include_str!("../../src/serve/remedies.md");
    let cells = page.lines().filter_map(|line| line.strip_prefix("| `")?.split_once("` | "));
    let rows: Vec<String> =
        cells.flat_map(|(words, _)| words.split("`, `")).map(String::from).collect();
    let rows: Vec<String> =
        rows.into_iter().filter(|word| !["kind", "error"].contains(&word.as_str())).collect();
    let each: BTreeSet<String> = rows.iter().cloned().collect();
    assert_eq!(rows.len(), each.len(), "a word stands twice, or means two things: {rows:?}");
    assert_eq!(each, doubts.into_iter().chain(warnings).chain(problems).collect());
}
