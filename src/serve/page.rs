//! The operator's page: a few files, built in.

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::IntoResponse;
use axum::routing::{MethodRouter, get};

/// (path, content type, text) of each file.
pub const FILES: [(&str, &str, &str); 14] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css")),
    ("/page.js", "text/javascript; charset=utf-8", include_str!("page/page.js")),
    ("/review.css", "text/css; charset=utf-8", include_str!("page/review.css")),
    ("/dom.js", "text/javascript; charset=utf-8", include_str!("page/dom.js")),
    ("/answer.js", "text/javascript; charset=utf-8", include_str!("page/answer.js")),
    ("/history.js", "text/javascript; charset=utf-8", include_str!("page/history.js")),
    ("/precision.js", "text/javascript; charset=utf-8", include_str!("page/precision.js")),
    ("/scan.js", "text/javascript; charset=utf-8", include_str!("page/scan.js")),
    ("/shelf.js", "text/javascript; charset=utf-8", include_str!("page/shelf.js")),
    ("/chart.js", "text/javascript; charset=utf-8", include_str!("page/chart.js")),
    ("/camera.js", "text/javascript; charset=utf-8", include_str!("page/camera.js")),
    ("/draw.js", "text/javascript; charset=utf-8", include_str!("page/draw.js")),
    ("/favicon.svg", "image/svg+xml", include_str!("page/favicon.svg")),
];

/// Answers with one of them.
pub fn file<S: Clone + Send + Sync + 'static>(
    content_type: &'static str,
    text: &'static str,
) -> MethodRouter<S> {
    // After an update of the program, no browser shows the old page.
    let headers = [(CONTENT_TYPE, content_type), (CACHE_CONTROL, "no-cache")];
    get(move || async move { (headers, text).into_response() })
}
