//! The OpenAPI document describes the paths that the router has, and no others.

use std::collections::BTreeSet;

use crate::common::http::serve;
use serde_json::Value;

/// The routes below `/api/v1`, as the source says: (method, path).
fn routes() -> BTreeSet<(String, String)> {
    let sources = [
        include_str!("../../src/serve/api.rs"),
        include_str!("../../src/serve/scans.rs"),
        include_str!("../../src/serve/review.rs"),
        include_str!("../../src/serve/audit.rs"),
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

#[test]
fn each_kind_of_doubt_has_its_row_among_the_remedies() {
    let document: Value =
        serde_json::from_str(include_str!("../../src/serve/openapi.json")).unwrap();
    let kinds = &document["components"]["schemas"]["Doubt"]["properties"]["kind"]["enum"];
    let kinds: BTreeSet<&str> =
        kinds.as_array().unwrap().iter().filter_map(Value::as_str).collect();
    let page = include_str!("../../src/serve/remedies.md");
    let rows = page.lines().filter_map(|line| line.strip_prefix("| `")?.split_once("` | "));
    let rows: BTreeSet<&str> = rows.map(|(kind, _)| kind).filter(|kind| *kind != "kind").collect();
    assert_eq!(rows, kinds);
}
