//! Reviews of past scans: what each truly was, for one scan or many, and scans that become trials.

use std::cell::LazyCell;
use std::collections::BTreeMap;
use std::sync::Arc;

use axum::extract::{Path, State};
use axum::response::Json;
use axum::routing::post;
use axum::{Extension, Router};
use serde::Deserialize;
use serde_json::{Value, json};

use super::hub::{Hub, Shared};
use super::request::{Problem, Reply, Said, aside, body, few, label};
use super::roles::By;
use super::scans::ScanPath;
use super::settings::LibraryFolder;
use super::subscribers::EventKind;
use crate::history::{Actor, AuditRecord, Correction, History, HistoryError, HistoryRow, Truth};
use crate::library::{About, LibraryError, recording};
use crate::record::TrialOptions;
use crate::record::edit::{self, Editor};
use crate::station::Command;
use crate::trial::{EXPERT, Trial, TrialKey};

/// How many corrections are published before subscribers get time to take them.
const PUBLISHED_AT_ONCE: usize = 64;

pub(super) fn router() -> Router<Arc<Hub>> {
    Router::new()
        .route("/scans/correct", post(correct_many))
        .route("/scans/{id}/correct", post(correct))
        .route("/scans/{id}/keep", post(keep))
}

/// The truth about a scan, as a request states it. An empty request removes the correction.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Was {
    surface: Option<String>,
    #[serde(default)]
    unknown: bool,
    #[serde(default)]
    bad: bool,
}

/// The same about several scans.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AllWere {
    ids: Vec<String>,
    surface: Option<String>,
    #[serde(default)]
    unknown: bool,
    #[serde(default)]
    bad: bool,
}

impl Was {
    fn truth(self) -> Reply<Option<Truth>> {
        match (self.surface, self.unknown, self.bad) {
            (None, false, false) => Ok(None),
            (None, true, false) => Ok(Some(Truth::Unknown)),
            (None, false, true) => Ok(Some(Truth::Bad)),
            (Some(surface), false, false) => {
                Ok(Some(Truth::Surface { surface: label("surface", &surface)? }))
            }
            _ => Err(Problem::Bad("give only one of `surface`, `unknown` and `bad`".into())),
        }
    }
}

async fn correct(
    State(hub): Shared,
    id: ScanPath,
    Extension(by): By,
    said: Said,
) -> Reply<Json<HistoryRow>> {
    let Path(id) = id?;
    let expected = "{\"surface\": \"oak\"}, {\"unknown\": true} or {\"bad\": true}";
    let truth = body::<Was>(said, expected)?.truth()?;
    let scan = corrected(&hub, vec![id], by, truth).await?.pop();
    Ok(Json(scan.unwrap_or(Err(Problem::NotFound))?))
}

/// Corrects up to 1000 scans in the same way, and says of each whether that was done.
async fn correct_many(State(hub): Shared, Extension(by): By, said: Said) -> Reply<Json<Value>> {
    let expected = "{\"ids\": [\"20260921-143000.001-01\"], \"surface\": \"oak\"}, or \
                    `\"unknown\": true`, `\"bad\": true` or neither in the place of `surface`";
    let AllWere { ids, surface, unknown, bad } = body(said, expected)?;
    let truth = Was { surface, unknown, bad }.truth()?;
    let ids = few("ids", ids)?;
    let scans = corrected(&hub, ids.clone(), by, truth).await?;
    let failed = scans.iter().filter(|scan| scan.is_err()).count();
    let each = ids.iter().zip(&scans).map(|(id, scan)| {
        let error = scan.as_ref().err();
        let word = error.map(|error| error.kind().1);
        json!({ "id": id, "error": word, "message": error.map(Problem::to_string) })
    });
    let each: Vec<Value> = each.collect();
    Ok(Json(json!({ "corrected": ids.len() - failed, "failed": failed, "each": each })))
}

/// A scan as it is after its correction, or why it was not corrected.
type Corrected = Reply<HistoryRow>;

/// Corrects scans, and tells subscribers and the station.
async fn corrected(
    hub: &Hub,
    ids: Vec<String>,
    by: Actor,
    truth: Option<Truth>,
) -> Reply<Vec<Corrected>> {
    let (history, library) = (hub.settings.history.clone(), hub.settings.library.clone());
    let work = move || Ok(correct_all(&history, library.as_ref(), &ids, (&by, truth)));
    let (scans, is_moved) = aside(work).await?;
    let done: Vec<&HistoryRow> = scans.iter().flatten().collect();
    for some in done.chunks(PUBLISHED_AT_ONCE) {
        some.iter().for_each(|scan| hub.lock().publish(EventKind::Correction, scan));
        tokio::task::yield_now().await;
    }
    if is_moved {
        // If the station is too busy to take this command, the operator can reload later.
        let _ = hub.order(Command::Reload);
    }
    Ok(scans)
}

/// Corrects scans one by one. Trials that were made of them move along, in one edit of the library.
/// The second result is whether trials moved.
fn correct_all(
    history: &History,
    library: Option<&LibraryFolder>,
    ids: &[String],
    (by, truth): (&Actor, Option<Truth>),
) -> (Vec<Corrected>, bool) {
    let _reviewing = history.reviewing();
    let correction = truth.map(|truth| Correction { truth, person: by.person.clone() });
    let found: Vec<Corrected> = ids.iter().map(|id| find(history, id)).collect();
    let trials = library.map(|library| trials_of(library, found.iter().flatten()));
    let trials = trials.unwrap_or_default();
    let label = correction.as_ref().and_then(Correction::surface);
    let moves = library.map(|library| move_trials(library, &trials, label)).transpose();
    let is_moved = matches!(&moves, Ok(Some(moves)) if !moves.is_empty());
    let correct = |scan: HistoryRow| {
        let id = &scan.head.id;
        let mut records = Vec::new();
        match &moves {
            _ if scan.became.is_none() && !trials.contains_key(id) => {}
            Err(error) => return Err(Problem::Failed(error.to_string())),
            Ok(None) => {}
            Ok(Some(moves)) => {
                let (from, to) =
                    moves.get(id).map_or((None, None), |(from, to)| (Some(from), to.as_ref()));
                let from = from.filter(|from| Some(*from) != to);
                let person = from.map_or(&scan.became_by, |_| &by.person);
                history.became(id, to.cloned(), person.clone())?;
                let action = if to.is_some() { "move" } else { "remove" };
                let to = to.map(String::as_str);
                records.extend(from.map(|from| moved(by, action, [Some(from), to])));
            }
        }
        let before = history.correct(id, correction.clone())?;
        let change =
            (before.as_ref().map(Correction::text), correction.as_ref().map(Correction::text));
        records.push(AuditRecord::now(by, "correct", Some(id), change));
        history.note_changes(records);
        Ok(history.answer(id)?)
    };
    (found.into_iter().map(|scan| correct(scan?)).collect(), is_moved)
}

fn find(history: &History, id: &str) -> Corrected {
    history.answer(id).map_err(|error| match error {
        // Among many, the message must say which one.
        HistoryError::NoScan(_) => Problem::Gone(error.to_string()),
        error => error.into(),
    })
}

/// The record of a trial that went from one place in the library to another, or to the removed trials
/// or back.
pub(super) fn moved(by: &Actor, action: &'static str, places: [Option<&str>; 2]) -> AuditRecord {
    let [from, to] = places.map(|place| place.filter(|place| !place.starts_with('.')));
    AuditRecord::now(by, action, from.or(to), (from, to))
}

/// Begins the note in the `trial.toml` of a trial that was made of a scan; the scan's id follows.
pub(super) const NOTE: &str = "scan ";

fn notes(scan: &HistoryRow) -> String {
    format!("{NOTE}{}", scan.head.id)
}

/// The trials of a library that were made of these scans, by the scan's id. The history may not know of
/// a trial that another program removed and restored, but its notes say where it is from.
fn trials_of<'a>(
    library: &LibraryFolder,
    scans: impl Iterator<Item = &'a HistoryRow>,
) -> BTreeMap<String, String> {
    let folder = &library.folder;
    let by_note = LazyCell::new(|| edit::trials_by_note(folder));
    let trial = |scan: &HistoryRow| {
        let notes = notes(scan);
        let trial = match scan.became.as_deref() {
            Some(became) => edit::trial_of_note(folder, &notes, Some(became)),
            None => by_note.get(&notes).cloned(),
        };
        Some((scan.head.id.clone(), trial?))
    };
    scans.filter_map(trial).collect()
}

/// Moves trials that were made of scans to another label, or removes them if `label` is `None`.
/// Returns the old and the new name of each, by the id of its scan.
fn move_trials(
    library: &LibraryFolder,
    trials: &BTreeMap<String, String>,
    label: Option<&str>,
) -> Result<BTreeMap<String, (String, Option<String>)>, LibraryError> {
    if trials.is_empty() {
        return Ok(BTreeMap::new());
    }
    let names: Vec<String> = trials.values().cloned().collect();
    let mut editor = Editor::open(&library.folder, &library.scene)?;
    let Some(label) = label else {
        editor.remove(&names)?;
        let gone = |(id, from): (&String, &String)| (id.clone(), (from.clone(), None));
        return Ok(trials.iter().map(gone).collect());
    };
    let moves = editor.move_to(&names, label)?.moves;
    // A trial that has this label already stays where it is.
    let to = |from: &String| moves.iter().find(|one| one.from == *from).map(|one| one.to.clone());
    let named = |(id, from): (&String, &String)| {
        (id.clone(), (from.clone(), Some(to(from).unwrap_or_else(|| from.clone()))))
    };
    Ok(trials.iter().map(named).collect())
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct KeepRequest {
    user: Option<String>,
}

async fn keep(
    State(hub): Shared,
    id: ScanPath,
    Extension(by): By,
    said: Said,
) -> Reply<Json<HistoryRow>> {
    let Path(id) = id?;
    let KeepRequest { user } = body(said, "{\"user\": \"anna\"}")?;
    let user = label("user", user.as_deref().unwrap_or(EXPERT))?;
    let library = hub.settings.library.clone().ok_or(Problem::NoLibrary)?;
    let history = hub.settings.history.clone();
    let scan = aside(move || {
        let _reviewing = history.reviewing();
        let scan = history.answer(&id)?;
        let id = &scan.head.id;
        let there = edit::trial_of_note(&library.folder, &notes(&scan), scan.became.as_deref());
        if let Some(trial) = there {
            // After a crash, the trial may exist although the history does not say so.
            history.became(id, Some(trial.clone()), scan.became_by.clone())?;
            let why = format!("this scan is a trial of the library already: {trial}");
            return Err(Problem::Bad(why));
        }
        let trial = to_library(&library, &scan, &history.folder(id)?, user)?;
        history.became(id, Some(trial.clone()), by.person.clone())?;
        history.note_changes([AuditRecord::now(&by, "keep", Some(id), (None, Some(&trial)))]);
        Ok(history.answer(id)?)
    });
    let scan = scan.await?;
    hub.lock().publish(EventKind::Correction, &scan);
    // If the station is too busy to take this command, the operator can reload later.
    let _ = hub.order(Command::Reload);
    Ok(Json(scan))
}

/// Writes a corrected scan into a library, and returns the name of the new trial.
fn to_library(
    library: &LibraryFolder,
    scan: &HistoryRow,
    folder: &std::path::Path,
    user: String,
) -> Reply<String> {
    let refuse = |why: &str| Err(Problem::Bad(why.into()));
    let Some(surface) = scan.correction.as_ref().and_then(Correction::surface) else {
        return refuse("say first which surface this scan was");
    };
    if !scan.spoiled.is_empty() {
        return refuse("this scan is spoiled, so it cannot become a trial");
    }
    let about = About::read(folder)?;
    let opened = recording::open_trial(folder, &library.scene)?;
    let [entry] = opened.entries.as_slice() else { return refuse("this scan holds no signals") };
    let key = TrialKey::new(surface, user, 1).with_session(about.session.clone());
    let trial = Trial { key, signals: entry.load()?.signals };
    let about = About { notes: Some(notes(scan)), ..about };
    let options = TrialOptions { about, durable: true };
    let what = format!("keep {} as a trial of {surface}", notes(scan));
    Ok(edit::keep(&library.folder, &library.scene, trial, &options, what)?)
}
