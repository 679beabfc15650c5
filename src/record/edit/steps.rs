//! The steps by which a library was edited, `LIBRARY/.removed/steps.jsonl`.
//!
//! ```text
//! {"began": {"what": "…", "at": "…", "moves": […]}}    before anything moves
//! "done"                                              the disk holds all of it
//! {"undoing": […]}                                    it is being taken back, by these moves
//! "undone"                                            the disk holds that, too
//! ```
//! So the last line tells what a crash left undone.

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{REMOVED, disk, is_plain};
use crate::library::{LibraryError, files};
use crate::record::failed;
use crate::system;
use crate::trial::TrialKey;

/// The list of steps in the folder of what was removed.
pub(super) const STEPS: &str = "steps.jsonl";
/// Limits in steps and bytes, at which the older half of the list is forgotten.
const MOST_STEPS: usize = 1000;
const MOST_BYTES: u64 = 1 << 25;

/// One edit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Step {
    /// The edit in words.
    pub what: String,
    /// When, in UTC.
    pub at: String,
    /// The trials, and their places before and after.
    pub moves: Vec<Move>,
}

/// A trial that went from one folder of a library to another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Move {
    /// The folder before, `SURFACE/TRIAL`, within the library.
    pub from: String,
    /// The folder after.
    pub to: String,
    /// Its name before; `None` for a trial that cannot be read.
    pub was: Option<TrialKey>,
    /// Its name now.
    pub is: Option<TrialKey>,
    /// Its inode, which tells it from another trial that has taken its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) inode: Option<u64>,
}

impl Move {
    /// The reverse move.
    pub(super) fn reversed(&self) -> Self {
        let Self { from, to, was, is, inode } = self.clone();
        Self { from: to, to: from, was: is, is: was, inode }
    }
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum StepLine {
    Began(Step),
    Done,
    Undoing(Vec<Move>),
    Undone,
}

/// A step, and where its lines begin.
pub(super) struct KnownStep {
    pub step: Step,
    at: u64,
    is_done: bool,
    undoing: Option<(u64, Vec<Move>)>,
}

impl KnownStep {
    /// The moves that a crash cut short, and whether they were undoing the step.
    pub fn left(&self) -> Option<(&[Move], bool)> {
        match &self.undoing {
            Some((_, moves)) => Some((moves, true)),
            None => (!self.is_done).then_some((&self.step.moves, false)),
        }
    }
}

/// The last step that can be undone.
///
/// # Errors
/// If the list of steps cannot be read.
pub fn last_step(library: &Path) -> Result<Option<Step>, LibraryError> {
    Ok(read(library)?.0.pop().map(|known| known.step))
}

/// All steps, the latest last, and where the last complete line ends. A line that a crash cut short
/// does not count, since nothing has moved yet; nor does one that leads out of the library.
pub(super) fn read(library: &Path) -> Result<(Vec<KnownStep>, u64), LibraryError> {
    let path = library.join(REMOVED).join(STEPS);
    let text = match files::open(&path) {
        Ok(_) => fs::read(&path).map_err(|error| LibraryError::io(&path, error))?,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok((Vec::new(), 0)),
        Err(error) => return Err(LibraryError::io(&path, error)),
    };
    let (mut steps, mut at) = (Vec::<KnownStep>::new(), 0);
    for line in text.split_inclusive(|&byte| byte == b'\n').filter(|line| line.ends_with(b"\n")) {
        // Version 0.2 wrote steps without `began`, once they were done.
        let bare = || serde_json::from_slice(line).ok().map(|step| (step, true));
        let known = |step, is_done| KnownStep { step, at, is_done, undoing: None };
        match (serde_json::from_slice(line), steps.last_mut()) {
            (Ok(StepLine::Began(step)), _) if is_within(&step.moves) => {
                steps.push(known(step, false));
            }
            (Ok(StepLine::Done), Some(last)) => last.is_done = true,
            (Ok(StepLine::Undoing(moves)), Some(last)) if is_within(&moves) => {
                last.undoing = Some((at, moves));
            }
            (Ok(StepLine::Undone), Some(_)) => undone(&mut steps),
            (Err(_), _) => {
                let bare = bare().filter(|(step, _): &(Step, bool)| is_within(&step.moves));
                steps.extend(bare.map(|(step, is_done)| known(step, is_done)));
            }
            _ => {}
        }
        at += line.len() as u64;
    }
    Ok((steps, at))
}

/// Takes the last step off the list. If undoing it put a trial in another place than before, notes
/// the new place in the earlier step that had put the trial there.
fn undone(steps: &mut Vec<KnownStep>) {
    let Some(KnownStep { step, undoing: Some((_, moves)), .. }) = steps.pop() else { return };
    for went in &moves {
        let Some(one) = step.moves.iter().find(|one| one.to == went.from) else { continue };
        let earlier = steps.iter_mut().rev().flat_map(|known| known.step.moves.iter_mut());
        let mut touching = earlier.filter(|other| other.to == one.from || other.from == one.from);
        // If the last that touched the place took a trial from it, this one came without a step.
        if let Some(before) = touching.next().filter(|other| other.to == one.from) {
            (before.to, before.is) = (went.to.clone(), went.is.clone());
        }
    }
}

/// Whether moves stay within a library: `SURFACE/TRIAL`, present or removed.
fn is_within(moves: &[Move]) -> bool {
    let trial = |name: &str| {
        let name = name.strip_prefix(".removed/").unwrap_or(name);
        name.split_once('/').is_some_and(|(surface, trial)| is_plain(surface) && is_plain(trial))
    };
    moves.iter().all(|one| trial(&one.from) && trial(&one.to))
}

/// Opens the list to be written, and cut: Windows cuts no file that is opened to append.
fn open(path: &Path) -> std::io::Result<File> {
    OpenOptions::new().write(true).create(true).truncate(false).open(path)
}

/// The list, open for one program alone.
pub(super) struct Steps {
    path: PathBuf,
    file: File,
    end: u64,
    known: Vec<KnownStep>,
    _lock: File,
}

impl Steps {
    /// Opens the list, once nobody else has it open.
    pub fn open(library: &Path) -> Result<Self, LibraryError> {
        let folder = library.join(REMOVED);
        let path = folder.join(STEPS);
        let fail = |error| failed(&path, error);
        disk::create_folder(&folder).map_err(fail)?;
        let lock = system::open_lock(&folder).map_err(fail)?;
        // Without locks, nobody is kept off.
        let _ = lock.lock();
        let (known, end) = read(library)?;
        let file = open(&path).map_err(fail)?;
        Ok(Self { path: path.clone(), file, end, known, _lock: lock })
    }

    pub fn last(&self) -> Option<&KnownStep> {
        self.known.last()
    }

    fn add(&mut self, lines: &[&StepLine]) -> Result<u64, LibraryError> {
        let at = self.end;
        let text = lines.iter().map(|line| {
            // Plain structs, numbers and text: nothing here that JSON cannot express.
            serde_json::to_string(line).unwrap_or_default() + "\n"
        });
        let text: String = text.collect();
        // A crash, or a full disk, may have left half a line.
        let mut append = || {
            if self.file.metadata()?.len() > at {
                disk::cut(&self.file, at)?;
            }
            disk::append(&mut self.file, text.as_bytes())
        };
        if let Err(error) = append() {
            // The line does not count. Best effort, since the next line cuts it off, too.
            let _ = disk::cut(&self.file, at);
            return Err(failed(&self.path, error));
        }
        self.end += text.len() as u64;
        Ok(at)
    }

    /// Notes that a step begins.
    pub fn begin(&mut self, step: &Step) -> Result<(), LibraryError> {
        if self.known.len() >= MOST_STEPS || self.end > MOST_BYTES {
            self.forget()?;
        }
        let at = self.add(&[&StepLine::Began(step.clone())])?;
        self.known.push(KnownStep { step: step.clone(), at, is_done: false, undoing: None });
        Ok(())
    }

    /// Notes that the step that was begun last is done.
    pub fn done(&mut self) -> Result<(), LibraryError> {
        self.add(&[&StepLine::Done])?;
        self.known.iter_mut().last().into_iter().for_each(|last| last.is_done = true);
        Ok(())
    }

    /// Notes a step that is complete already.
    pub fn note(&mut self, step: Step) -> Result<(), LibraryError> {
        self.add(&[&StepLine::Began(step), &StepLine::Done]).map(drop)
    }

    /// Notes that the last step is being undone, by these moves.
    pub fn undo(&mut self, moves: Vec<Move>) -> Result<(), LibraryError> {
        let at = self.add(&[&StepLine::Undoing(moves.clone())])?;
        self.known.iter_mut().last().into_iter().for_each(|last| {
            last.undoing = Some((at, moves.clone()));
        });
        Ok(())
    }

    /// Strikes the last step, or the undoing of it, off the list.
    pub fn take_back(&mut self, undoing: bool) -> Result<(), LibraryError> {
        let Some(last) = self.known.last_mut() else { return Ok(()) };
        let at = last.undoing.as_ref().filter(|_| undoing).map_or(last.at, |(at, _)| *at);
        disk::cut(&self.file, at).map_err(|error| failed(&self.path, error))?;
        self.end = at;
        match undoing {
            true => last.undoing = None,
            false => drop(self.known.pop()),
        }
        Ok(())
    }

    /// Notes that the last step is undone.
    pub fn undone(&mut self) -> Result<(), LibraryError> {
        self.add(&[&StepLine::Undone])?;
        undone(&mut self.known);
        Ok(())
    }

    /// Writes the list anew with the newer half of its steps.
    fn forget(&mut self) -> Result<(), LibraryError> {
        self.known.drain(..self.known.len().div_ceil(2));
        let (before, mut text) = (std::mem::take(&mut self.known), String::new());
        for mut known in before {
            known.at = text.len() as u64;
            for line in [StepLine::Began(known.step.clone()), StepLine::Done] {
                text += &(serde_json::to_string(&line).unwrap_or_default() + "\n");
            }
            self.known.push(known);
        }
        let folder = self.path.parent().unwrap_or(&self.path);
        let replace = || {
            let mut file = super::super::unfinished(".steps.").tempfile_in(folder)?;
            file.write_all(text.as_bytes())?;
            file.as_file().sync_all()?;
            system::persist(file, &self.path)?;
            open(&self.path)
        };
        self.file = replace().map_err(|error| failed(&self.path, error))?;
        self.end = text.len() as u64;
        Ok(())
    }
}
