//! The list of steps (edits of a library), in the file `LIBRARY/.removed/steps.jsonl`.
//!
//! ```text
//! {"began": {"what": "…", "at": "…", "moves": […]}}    a step begins: nothing has moved yet
//! "done"                                              the disk holds all moves of the step
//! {"undoing": […]}                                    the step is being undone by these moves
//! "undone"                                            the disk holds these moves, too
//! ```
//! So the last line tells which step a crash cut short. For a step that cannot be carried out,
//! "undone" follows "began"; for one that cannot be undone, "done" follows "undoing".

use std::fs::{self, File, OpenOptions};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use super::{REMOVED, disk};
use crate::library::{LibraryError, files};
use crate::printable::json_text;
use crate::record::folder_name::is_trial;
use crate::record::{failed, replace_file};
use crate::system::{self, Locked};
use crate::trial::{TrialKey, utc};

/// Name of the file that lists the steps, in the folder of removed trials.
pub(super) const STEPS: &str = "steps.jsonl";
/// Limits of the list of steps, in steps and in bytes. At either limit, the older half is dropped.
const MOST_STEPS: usize = 1000;
const MOST_BYTES: u64 = 1 << 25;

/// An edit of a library.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Step {
    /// The edit in words, such as `rename oak to ash`.
    pub what: String,
    /// When the edit began, in UTC.
    pub at: String,
    /// The trials that the edit moves, and their places before and after.
    pub moves: Vec<Move>,
    /// Set by undoing: the trials, `SURFACE/TRIAL`, that were missing from where the step put them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gone: Option<Vec<String>>,
}

impl Step {
    pub(super) fn now(what: String, moves: Vec<Move>) -> Self {
        Self { what, at: utc(SystemTime::now()), moves, gone: None }
    }
}

/// The move of a trial from one place in a library to another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Move {
    /// The trial's folder or file before the move, within the library, such as `SURFACE/TRIAL`.
    pub from: String,
    pub to: String,
    /// The trial's label, user and number before the move; `None` if the trial cannot be read.
    pub was: Option<TrialKey>,
    pub is: Option<TrialKey>,
    /// The trial's inode (file number), which tells it from another trial at the same path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) inode: Option<u64>,
}

impl Move {
    pub(super) fn reversed(&self) -> Self {
        let Self { from, to, was, is, inode } = self.clone();
        Self { from: to, to: from, was: is, is: was, inode }
    }
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum StepLine {
    Began(Step),
    Done,
    Undoing(Vec<Move>),
    Undone,
}

/// A step, and whether it is done, unfinished, or being undone.
pub(super) struct KnownStep {
    pub step: Step,
    is_done: bool,
    undoing: Option<Vec<Move>>,
}

impl KnownStep {
    /// The moves that a crash cut short, if any; true if they were undoing the step.
    pub(super) fn left(&self) -> Option<(&[Move], bool)> {
        match &self.undoing {
            Some(moves) => Some((moves, true)),
            None => (!self.is_done).then_some((&self.step.moves, false)),
        }
    }
}

/// The last step, which can be undone; `None` if there is none.
///
/// # Errors
/// If the list of steps cannot be read.
pub fn last_step(library: &Path) -> Result<Option<Step>, LibraryError> {
    Ok(read(library)?.0.pop().map(|known| known.step))
}

/// All steps, the latest last, and the byte where the last complete line ends. Skips a line that a
/// crash cut short (its moves had not begun), and a line with a path outside the library.
pub(super) fn read(library: &Path) -> Result<(Vec<KnownStep>, u64), LibraryError> {
    let path = library.join(REMOVED).join(STEPS);
    let text = match files::open(&path) {
        Ok(_) => fs::read(&path).map_err(|error| LibraryError::io(&path, error))?,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok((Vec::new(), 0)),
        Err(error) => return Err(LibraryError::io(&path, error)),
    };
    let (mut steps, mut at) = (Vec::new(), 0);
    for line in text.split_inclusive(|&byte| byte == b'\n').filter(|line| line.ends_with(b"\n")) {
        match serde_json::from_slice(line) {
            Ok(StepLine::Began(Step { moves, .. }) | StepLine::Undoing(moves))
                if !is_within(&moves) => {}
            Ok(line) => follow(&mut steps, line),
            // Reads a step of version 0.2, which wrote no `began`, and wrote only finished steps.
            Err(_) => {
                let bare: Option<Step> = serde_json::from_slice(line).ok();
                let bare = bare.filter(|step| is_within(&step.moves));
                steps.extend(bare.map(|step| KnownStep { step, is_done: true, undoing: None }));
            }
        }
        at += line.len() as u64;
    }
    Ok((steps, at))
}

/// Updates the list of steps by the next line of its file.
fn follow(steps: &mut Vec<KnownStep>, line: StepLine) {
    match (line, steps.last_mut()) {
        (StepLine::Began(step), _) => {
            steps.push(KnownStep { step, is_done: false, undoing: None });
        }
        (StepLine::Done, Some(last)) => (last.is_done, last.undoing) = (true, None),
        (StepLine::Undoing(moves), Some(last)) => last.undoing = Some(moves),
        (StepLine::Undone, Some(_)) => undone(steps),
        (_, None) => {}
    }
}

/// Takes the last step, which was undone, off the list. If undoing put a trial in another place
/// than before, corrects the place in the earlier step that had put the trial there.
fn undone(steps: &mut Vec<KnownStep>) {
    let Some(KnownStep { step, undoing: Some(moves), .. }) = steps.pop() else { return };
    for went in &moves {
        let Some(one) = step.moves.iter().find(|one| one.to == went.from) else { continue };
        let earlier = steps.iter_mut().rev().flat_map(|known| known.step.moves.iter_mut());
        let mut touching = earlier.filter(|other| other.to == one.from || other.from == one.from);
        // Only a step that put a trial there is corrected, not a step that took a trial away.
        if let Some(before) = touching.next().filter(|other| other.to == one.from) {
            (before.to, before.is) = (went.to.clone(), went.is.clone());
        }
    }
}

/// Whether all moves stay within a library: on paths `SURFACE/TRIAL`, present or removed.
fn is_within(moves: &[Move]) -> bool {
    let trial = |name: &str| is_trial(name.strip_prefix(".removed/").unwrap_or(name));
    moves.iter().all(|one| trial(&one.from) && trial(&one.to))
}

/// Opens the list for writing. Append mode is avoided, since Windows cannot shorten a file in it.
fn open(path: &Path) -> std::io::Result<File> {
    OpenOptions::new().write(true).create(true).truncate(false).open(path)
}

/// The list of steps, open for one program alone.
pub(super) struct Steps {
    path: PathBuf,
    file: File,
    end: u64,
    /// All steps, the latest last.
    pub known: Vec<KnownStep>,
    _lock: Locked,
}

impl Steps {
    /// Waits until no other program has the list of steps open, and opens it.
    pub(super) fn open(library: &Path) -> Result<Self, LibraryError> {
        let folder = library.join(REMOVED);
        let path = folder.join(STEPS);
        let fail = |error| failed(&path, error);
        disk::create_folder(&folder).map_err(fail)?;
        let lock = system::open_lock(&folder).map_err(fail)?;
        // A failure is ignored: some file systems have no locks to keep other programs out.
        let _ = lock.lock();
        let (known, end) = read(library)?;
        let file = open(&path).map_err(fail)?;
        Ok(Self { path: path.clone(), file, end, known, _lock: Locked(lock) })
    }

    /// Adds lines to the list of steps: all of them or, after an error, none.
    pub(super) fn add(
        &mut self,
        lines: impl IntoIterator<Item = StepLine>,
    ) -> Result<(), LibraryError> {
        let lines: Vec<StepLine> = lines.into_iter().collect();
        let is_new = matches!(lines[..], [StepLine::Began(_), ..]);
        if is_new && (self.known.len() >= MOST_STEPS || self.end > MOST_BYTES) {
            self.forget()?;
        }
        let at = self.end;
        let text: String = lines.iter().map(|line| json_text(line) + "\n").collect();
        // Cuts off half a line, which a crash or a full disk may have left.
        let mut append = || {
            if self.file.metadata()?.len() > at {
                disk::cut(&self.file, at)?;
            }
            disk::append(&mut self.file, text.as_bytes())
        };
        if let Err(error) = append() {
            // Cuts the new lines off again. Errors are ignored, since the next call cuts, too.
            let _ = disk::cut(&self.file, at);
            return Err(failed(&self.path, error));
        }
        self.end += text.len() as u64;
        lines.into_iter().for_each(|line| follow(&mut self.known, line));
        Ok(())
    }

    /// Drops the older half of the steps, and writes the list anew.
    fn forget(&mut self) -> Result<(), LibraryError> {
        self.known.drain(..self.known.len().div_ceil(2));
        let lines = |known: &KnownStep| {
            let lines = [StepLine::Began(known.step.clone()), StepLine::Done];
            lines.map(|line| json_text(&line) + "\n").concat()
        };
        let text: String = self.known.iter().map(lines).collect();
        replace_file(&self.path, text.as_bytes())?;
        self.file = open(&self.path).map_err(|error| failed(&self.path, error))?;
        self.end = text.len() as u64;
        Ok(())
    }
}
