//! The HTTP API and the files of the page, with the handler of each path.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::{DefaultBodyLimit, Query, State};
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Json, Response};
use axum::routing::{MethodRouter, get, post};
use axum::{Extension, Router};
use serde::Deserialize;
use serde_json::{Value, json};

use super::guard::{Guard, Traffic, guard};
use super::hub::{Hub, Shared};
use super::request::{
    Asked, JSON_LINES, MOST, Problem, Reply, Said, USUAL, aside, body, exported, label,
};
use super::roles::By;
use super::settings::{LARGEST_BODY, Settings};
use super::subscribers::EventFilter;
use super::{library, metrics, review, roles, scans};
use crate::history::{Actor, AuditRecord};
use crate::printable::counted;
use crate::station::Command;
use crate::trial::EXPERT;

const MOST_TRIALS: u32 = 1000;

pub(crate) fn router(hub: Arc<Hub>, settings: &Settings) -> Router {
    let api = Router::new()
        .route("/me", get(roles::me))
        .route("/state", get(state))
        .merge(scans::router())
        .merge(review::router())
        .merge(library::router())
        .route("/library", get(library))
        .route("/audit", get(audit))
        .route("/audit.jsonl", get(audit_lines))
        .route("/events", get(events))
        .route("/openapi.json", get(open_api))
        .route("/start", order_by_post("start", Command::Start))
        .route("/stop", order_by_post("stop", Command::Stop))
        .route("/reload", order_by_post("reload", Command::Reload))
        .route("/enroll", post(enroll))
        .route("/enroll/keep", post(keep_refused))
        .route("/enroll/end", order_by_post("enroll/end", Command::EndEnroll));
    let mut router = Router::new()
        .nest("/api/v1", api)
        .route("/metrics", get(all_metrics))
        .route("/healthz", get(health))
        .route("/readyz", get(ready));
    for (path, content_type, text) in FILES {
        router = router.route(path, file(content_type, text));
    }
    guarded(router, hub.traffic.clone(), settings).with_state(hub)
}

/// Protects the paths of a router by the guard, and refuses all other paths.
pub(crate) fn guarded<S: Clone + Send + Sync + 'static>(
    router: Router<S>,
    traffic: Arc<Traffic>,
    settings: &Settings,
) -> Router<S> {
    let checks = Arc::new(Guard::new(traffic, settings));
    router
        .fallback(|| async { Problem::NotFound })
        .method_not_allowed_fallback(|| async { Problem::Method })
        .layer(DefaultBodyLimit::max(LARGEST_BODY))
        .layer(axum::middleware::from_fn_with_state(checks, guard))
}

async fn state(State(hub): Shared) -> Response {
    Json(hub.lock().whole()).into_response()
}

async fn library(State(hub): Shared) -> Response {
    Json(&hub.lock().state.library).into_response()
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AuditRequest {
    limit: Option<usize>,
    /// Only changes older than the one with this id.
    before: Option<u64>,
}

/// The newest changes: who changed what. For administrators, like all of the audit log.
async fn audit(State(hub): Shared, asked: Asked<AuditRequest>) -> Reply<Json<Value>> {
    let Query(AuditRequest { limit, before }) = asked?;
    let most = limit.unwrap_or(USUAL).min(MOST);
    let changes = aside(move || Ok(hub.settings.history.changes(before, most)?)).await?;
    Ok(Json(json!({ "changes": changes })))
}

async fn audit_lines(State(hub): Shared) -> Response {
    exported(JSON_LINES, move |out| hub.settings.history.write_changes(out))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Types {
    types: Option<String>,
}

async fn events(State(hub): Shared, types: Asked<Types>) -> Reply {
    let Query(Types { types }) = types?;
    let filter = types.as_deref().map_or(Ok(EventFilter::ALL), EventFilter::parse);
    let stream = hub.subscribe(filter.map_err(Problem::Bad)?).ok_or(Problem::Readers)?;
    let headers = [(CONTENT_TYPE, "text/event-stream"), (CACHE_CONTROL, "no-cache")];
    Ok((headers, Body::from_stream(stream)).into_response())
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Enroll {
    surface: String,
    user: Option<String>,
    trials: Option<u32>,
    /// Whether the order may take the place of another; it may unless this is false.
    replace: Option<bool>,
}

async fn enroll(State(hub): Shared, Extension(by): By, said: Said) -> Reply {
    let expected = "{\"surface\": \"oak\", \"user\": \"anna\", \"trials\": 3}";
    let Enroll { surface, user, trials, replace } = body(said, expected)?;
    let surface = label("surface", &surface)?;
    let user = label("user", user.as_deref().unwrap_or(EXPERT))?;
    let trials = trials.unwrap_or(1);
    if !(1..=MOST_TRIALS).contains(&trials) {
        return Err(Problem::Bad(format!("`trials` is {trials}; expected 1 to {MOST_TRIALS}")));
    }
    if replace == Some(false)
        && let Some(standing) = &hub.lock().state.enrolling
    {
        let who = standing.ordered_by.as_ref().unwrap_or(&standing.user);
        return Err(Problem::Standing(who.clone(), standing.surface.clone()));
    }
    let ordered_by = by.person.clone();
    send(hub, by, "enroll", Command::Enroll { surface, user, trials, ordered_by }).await
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct KeepRefused {
    scan: u32,
}

async fn keep_refused(State(hub): Shared, Extension(by): By, said: Said) -> Reply {
    let KeepRefused { scan } = body(said, "{\"scan\": 7}")?;
    send(hub, by, "enroll/keep", Command::KeepRefused(scan)).await
}

async fn open_api() -> Response {
    ([(CONTENT_TYPE, "application/json")], include_str!("openapi.json")).into_response()
}

fn order_by_post(accepted: &'static str, order: Command) -> MethodRouter<Arc<Hub>> {
    post(move |State(hub): Shared, Extension(by): By| send(hub, by, accepted, order))
}

/// Gives the station an order. The audit log gets those that change what is kept or compared.
async fn send(hub: Arc<Hub>, by: Actor, accepted: &'static str, order: Command) -> Reply {
    let (subject, after) = match &order {
        Command::Enroll { surface, user, trials, .. } => {
            let trials = counted(*trials as usize, "trial");
            (Some(surface.clone()), Some(format!("{trials} of {user}")))
        }
        Command::KeepRefused(scan) => (Some(format!("scan {scan}")), None),
        _ => (None, None),
    };
    let is_noted = !matches!(order, Command::Start | Command::Stop);
    hub.order(order)?;
    if is_noted {
        let change = (None, after.as_deref());
        let record = AuditRecord::now(&by, accepted, subject.as_deref(), change);
        let note = move || {
            hub.settings.history.note_changes([record]);
            Ok(())
        };
        aside(note).await?;
    }
    Ok((StatusCode::ACCEPTED, Json(json!({ "accepted": accepted }))).into_response())
}

async fn all_metrics(State(hub): Shared) -> Response {
    ([(CONTENT_TYPE, metrics::CONTENT_TYPE)], hub.metrics()).into_response()
}

async fn health(State(hub): Shared) -> Response {
    let (status, text) = match hub.lock().state.finished {
        false => (StatusCode::OK, "ok"),
        true => (StatusCode::SERVICE_UNAVAILABLE, "ended"),
    };
    (status, Json(json!({ "status": text }))).into_response()
}

/// Whether scans can be named now. Says what is not ready, but no names, since it needs no token.
async fn ready(State(hub): Shared) -> Response {
    let hub = hub.lock();
    let lacking = hub.state.lacking();
    let (status, text) = match lacking.is_empty() {
        true => (StatusCode::OK, "ready"),
        false => (StatusCode::SERVICE_UNAVAILABLE, "not ready"),
    };
    (status, Json(json!({ "status": text, "lacking": lacking }))).into_response()
}

/// The files of the page: path, content type and text of each.
pub(crate) const FILES: [(&str, &str, &str); 21] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css")),
    ("/page.js", "text/javascript; charset=utf-8", include_str!("page/page.js")),
    ("/review.css", "text/css; charset=utf-8", include_str!("page/review.css")),
    ("/dom.js", "text/javascript; charset=utf-8", include_str!("page/dom.js")),
    ("/link.js", "text/javascript; charset=utf-8", include_str!("page/link.js")),
    ("/answer.js", "text/javascript; charset=utf-8", include_str!("page/answer.js")),
    ("/history.js", "text/javascript; charset=utf-8", include_str!("page/history.js")),
    ("/now.js", "text/javascript; charset=utf-8", include_str!("page/now.js")),
    ("/person.js", "text/javascript; charset=utf-8", include_str!("page/person.js")),
    ("/changes.js", "text/javascript; charset=utf-8", include_str!("page/changes.js")),
    ("/select.js", "text/javascript; charset=utf-8", include_str!("page/select.js")),
    ("/enrol.js", "text/javascript; charset=utf-8", include_str!("page/enrol.js")),
    ("/route.js", "text/javascript; charset=utf-8", include_str!("page/route.js")),
    ("/scan.js", "text/javascript; charset=utf-8", include_str!("page/scan.js")),
    ("/shelf.js", "text/javascript; charset=utf-8", include_str!("page/shelf.js")),
    ("/drift.js", "text/javascript; charset=utf-8", include_str!("page/drift.js")),
    ("/chart.js", "text/javascript; charset=utf-8", include_str!("page/chart.js")),
    ("/camera.js", "text/javascript; charset=utf-8", include_str!("page/camera.js")),
    ("/draw.js", "text/javascript; charset=utf-8", include_str!("page/draw.js")),
    ("/favicon.svg", "image/svg+xml", include_str!("page/favicon.svg")),
];

pub(crate) fn file<S: Clone + Send + Sync + 'static>(
    content_type: &'static str,
    text: &'static str,
) -> MethodRouter<S> {
    // Without this header, a browser might show the old page after an update of the program.
    let headers = [(CONTENT_TYPE, content_type), (CACHE_CONTROL, "no-cache")];
    get(move || async move { (headers, text).into_response() })
}
