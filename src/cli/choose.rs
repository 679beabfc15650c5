//! Chooses the trials, sources and folds that a measurement works with.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::condition::value_of;
use super::show::{counted, listed};
use super::{Done, Failure, Named, one_of, say};
use crate::evaluate::{self, Fold, Leaks, Protocol, Split, TEST, TRAIN, in_libraries};
use crate::library::{Entry, Library};
use crate::scene::{Scene, SourceId};
use crate::trial::TrialKey;

pub(super) fn protocols() -> [Named<Protocol>; 4] {
    [
        (
            Protocol::AllVsOneUser,
            "Each fold names the trials of one person; the library is everybody else's trials (10 vs 1)",
        ),
        (
            Protocol::LeaveOneSessionOut,
            "Each fold names the trials of one session; the library is the trials of all other sessions",
        ),
        (
            Protocol::LeaveOneTrialOut,
            "Fold k names trial k of every surface; the library is the same person's other trials (1 vs 1)",
        ),
        (
            Protocol::ExpertVsUsers,
            "The library is the expert's trials; each fold names the trials of one other user (1 vs 10)",
        ),
    ]
    .map(|(protocol, help)| (protocol, protocol.name(), help))
}

/// The trials, sources and folds of a measurement.
pub(super) struct Choice {
    pub scene: Scene,
    /// Trials that hold at least one of the scene's sources.
    pub entries: Vec<Entry>,
    pub split: Split,
}

/// How queries and library are split.
#[derive(Clone, Debug, Default, clap::Args)]
pub(super) struct SplitArgs {
    /// How queries and library are split (default: the hardest that the data allow: other people, else other sessions, else other trials)
    #[arg(long, value_parser = one_of(protocols()))]
    pub protocol: Option<Protocol>,
    /// Split as a table says: a line for each trial, with its folder and its fold, or `train` or `test`
    #[arg(long, value_name = "FILE.csv", conflicts_with = "protocol")]
    pub split: Option<PathBuf>,
    /// Leave out the trials of each person (user), session, or value of a key under [meta] in turn
    #[arg(long, value_name = "KEY", conflicts_with_all = ["protocol", "split"])]
    pub group_by: Option<String>,
}

/// The trials to split: recordings below a folder, or feature tables.
#[derive(Clone, Copy)]
pub(super) enum Splittable<'a> {
    Recordings(&'a Path, &'a [Entry]),
    Features(&'a [TrialKey]),
}

impl Splittable<'_> {
    pub(super) fn keys(self) -> Vec<TrialKey> {
        match self {
            Self::Recordings(_, entries) => entries.iter().map(|entry| entry.key.clone()).collect(),
            Self::Features(keys) => keys.to_vec(),
        }
    }

    pub(super) fn names(self) -> Vec<String> {
        match self {
            Self::Recordings(data, entries) => entries.iter().map(|e| e.name_in(data)).collect(),
            Self::Features(keys) => keys.iter().map(ToString::to_string).collect(),
        }
    }
}

impl SplitArgs {
    /// The folds that the user asked for, or of the hardest protocol that fits (which is printed). An error
    /// names a line or a trial that does not fit.
    pub(super) fn split(&self, trials: Splittable<'_>) -> Done<Split> {
        let keys = trials.keys();
        let protocol = match (&self.split, self.group_by.as_deref(), self.protocol) {
            (Some(path), ..) => return Ok(Split::by_table(&from_table(path, trials)?, &keys)?),
            (_, Some("user"), _) => Some(Protocol::AllVsOneUser),
            (_, Some("session"), _) => Some(Protocol::LeaveOneSessionOut),
            (_, Some(key), _) => return Ok(Split::by_key(key, &groups(key, trials)?, &keys)?),
            (.., named) => named,
        };
        let split = Split::by_protocol(protocol.unwrap_or_else(|| hardest(&keys)), &keys)?;
        if protocol.is_none() {
            say!("protocol: {} ({})", split.name, split.left_out);
        }
        Ok(split)
    }

    /// Limits the recordings of the library at `data` to the sources of a scene, and splits them.
    pub(super) fn choose(&self, data: &Path, library: &Library, scene: Scene) -> Done<Choice> {
        let entries = within(library, &scene)?;
        let trials = Splittable::Recordings(data, &entries);
        let (mut split, keys) = (self.split(trials)?, trials.keys());
        let leaks = Leaks::of(&entries, &say::progress);
        let warning;
        (split.folds, warning) = kept_apart(split.folds, &keys, &leaks);
        warning.iter().for_each(|warning| say!("warning: {warning}"));
        Ok(Choice { scene, entries, split })
    }
}

pub(super) fn hardest(keys: &[TrialKey]) -> Protocol {
    Protocol::fitting(keys).unwrap_or(Protocol::LeaveOneTrialOut)
}

fn groups(key: &str, trials: Splittable<'_>) -> Done<Vec<String>> {
    let Splittable::Recordings(data, entries) = trials else {
        let problem = "--group-by takes user or session here; feature tables have no [meta]";
        return Err(Failure::usage(problem));
    };
    let of = |entry: &Entry| match value_of(entry, &entry.about()?.meta, key) {
        Some(toml::Value::String(text)) => Ok(text),
        Some(value) => Ok(value.to_string()),
        None => {
            let name = entry.name_in(data);
            let problem = format!(
                "{name} has no `{key}`; write it under [meta] of its trial.toml, or leave such trials \
                 out with --where"
            );
            Err(Failure::usage_at(data, problem))
        }
    };
    entries.iter().map(of).collect()
}

/// The fold of each trial, from a table of trials and folds.
fn from_table(path: &Path, trials: Splittable<'_>) -> Done<Vec<String>> {
    let names = trials.names();
    let mut rows = csv::ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .trim(csv::Trim::All)
        .from_path(path)
        .map_err(|error| Failure::usage_at(path, error))?;
    let mut of: BTreeMap<String, String> = BTreeMap::new();
    for (at, row) in rows.records().enumerate() {
        let row = row.map_err(|error| Failure::usage_at(path, error))?;
        let line = row.position().map_or(0, csv::Position::line);
        let wrong = |problem: String| Failure::usage_at(path, format!("line {line}: {problem}"));
        let (Some(trial), Some(fold), None) = (row.get(0), row.get(1), row.get(2)) else {
            let expected =
                "expected two cells, the folder of a trial (such as oak/trial1) and its fold";
            return Err(wrong(expected.into()));
        };
        let trial = trial.replace('\\', "/").trim_end_matches('/').to_string();
        if at == 0 && trial == "trial" && !names.contains(&trial) {
            continue;
        }
        if trial.is_empty() || fold.is_empty() {
            return Err(wrong("a cell is empty; each trial needs a fold".into()));
        }
        // A trial may be there, but not used, since `--where` leaves it out.
        let is_there =
            matches!(trials, Splittable::Recordings(data, _) if data.join(&trial).exists());
        if !names.contains(&trial) && !is_there {
            let such = names.first().map(|name| format!(", such as {name}")).unwrap_or_default();
            return Err(wrong(format!("the data have no trial `{trial}`; write its folder{such}")));
        }
        if of.insert(trial.clone(), fold.into()).is_some() {
            return Err(wrong(format!("{trial} has a fold already, in a line above")));
        }
        let is_part = |fold: &str| [TRAIN, TEST].contains(&fold);
        if let Some(other) = of.values().find(|other| is_part(other) != is_part(fold)) {
            let problem = format!(
                "`{fold}` and `{other}` do not go together: use {TRAIN} and {TEST}, or folds"
            );
            return Err(wrong(problem));
        }
    }
    let fold = |name: &String| {
        of.get(name).cloned().ok_or_else(|| {
            let problem =
                format!("{name} has no line; give it a fold, or leave it out with --where");
            Failure::usage_at(path, problem)
        })
    };
    names.iter().map(fold).collect()
}

/// The trials that hold any source of `scene`, limited to these sources.
pub(super) fn within(library: &Library, scene: &Scene) -> Done<Vec<Entry>> {
    let entries = evaluate::within(&library.entries, scene);
    if entries.is_empty() {
        let wanted: BTreeSet<&SourceId> = scene.sources().map(|spec| &spec.id).collect();
        let held: BTreeSet<_> = library.entries.iter().flat_map(|entry| &entry.sources).collect();
        let held = if held.is_empty() { "none that is known".into() } else { listed(held) };
        let wanted = listed(wanted);
        return Err(Failure::Failed(format!(
            "{}: no trial holds {wanted}; sources that the data hold: {held}",
            library.name
        )));
    }
    Ok(entries)
}

/// Takes trials that share samples with a query out of the library of its fold. Also returns a warning
/// if any do, which says if that cannot be done.
pub(super) fn kept_apart(
    folds: Vec<Fold>,
    keys: &[TrialKey],
    leaks: &Leaks,
) -> (Vec<Fold>, Option<String>) {
    let Some(found) = leaks.text(keys, |trial| keys[trial].to_string()) else {
        return (folds, None);
    };
    let Some(apart) = leaks.apart(&folds, keys) else {
        let why = "without these trials no library has two surfaces";
        let warning =
            format!("{found}; they cannot be kept together ({why}): the accuracy is too high");
        return (folds, Some(warning));
    };
    let queries = |folds: &[Fold]| folds.iter().map(|fold| fold.queries.len()).sum::<usize>();
    let lost = match queries(&folds) - queries(&apart) {
        0 => String::new(),
        lost => format!(
            "; {} not asked, since nothing else of their surface is left",
            counted(lost, "trial")
        ),
    };
    let kept = "kept together: none is named by the samples that it shares";
    (apart, Some(format!("{found}; {kept}{lost}")))
}

impl Choice {
    /// Keeps at most `most` of the surfaces in the folds, evenly spread over their sorted names. Fails if
    /// these are fewer than two.
    pub(super) fn keep_surfaces(&mut self, most: usize) -> Done<()> {
        let all: BTreeSet<&str> = self.surfaces().collect();
        let kept: BTreeSet<String> = (all.iter().enumerate())
            .filter(|(i, _)| (i + 1) * most / all.len() > i * most / all.len())
            .map(|(_, name)| (*name).to_string())
            .collect();
        if kept.len() < 2 {
            return Err(Failure::usage("a chart takes at least two surfaces"));
        }
        let is_kept = |i: &usize| kept.contains(&self.entries[*i].key.surface);
        for fold in &mut self.split.folds {
            fold.library.retain(is_kept);
            fold.queries.retain(is_kept);
        }
        self.split.folds.retain(|fold| !fold.queries.is_empty());
        Ok(())
    }

    /// The surface of each trial that is in the library of at least one fold.
    pub(super) fn surfaces(&self) -> impl Iterator<Item = &str> {
        in_libraries(&self.split.folds).into_iter().map(|i| self.entries[i].key.surface.as_str())
    }

    /// The sources that are held by trials of the folds, sorted.
    pub(super) fn held(&self) -> Vec<SourceId> {
        let of_folds =
            self.split.folds.iter().flat_map(|fold| fold.library.iter().chain(&fold.queries));
        let held: BTreeSet<&SourceId> = of_folds.flat_map(|&i| &self.entries[i].sources).collect();
        held.into_iter().cloned().collect()
    }
}
