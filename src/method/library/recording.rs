//! Reads the recording format, version 1: `LIBRARY/SURFACE/TRIAL/mi2.wav`, with a file for each source, and
//! its shorter forms. `README.md` beside this file describes them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::files::{self, Listed, number_in};
use super::loader::{FileTrial, Headers, Remarks, SourceFiles};
use super::{About, Entry, Library, LibraryError, Opened, series_file};
use crate::printable::counted;
use crate::scene::{Domain, LibraryToml, Scene, SourceBlock, SourceId};
use crate::trial::{EXPERT, TrialKey, UNLABELLED, normal};

pub(crate) const DESCRIPTION: &str = "library.toml";

/// The extensions of pictures, in lower case.
const PICTURES: [&str; 3] = ["png", "jpg", "jpeg"];

/// Suffix of a trial's folder while the trial is still being written.
pub const UNFINISHED: &str = ".unfinished";

/// Suffix of a library's folder while an import is still writing it.
pub(crate) const IMPORTING: &str = ".importing";

/// Opens a library in the recording format. Samples are read when an entry is loaded.
///
/// The sources are those of `defaults` and of `library.toml`; `library.toml` wins if both describe
/// a source. [`Library::remarks`] names the skipped files; [`Opened::bad`] lists the files and
/// trials that cannot be used.
///
/// # Errors
/// If the folder cannot be read, `library.toml` is wrong, or nothing can be used.
pub fn open_usable(path: &Path, defaults: &Scene) -> Result<Opened, LibraryError> {
    something(path, open_part(path, path, defaults)?)
}

/// Like [`open_usable`], but uses the `library.toml` in `described_in`, and may find no trials.
pub(crate) fn open_part(
    path: &Path,
    described_in: &Path,
    defaults: &Scene,
) -> Result<Opened, LibraryError> {
    let folders = files::list(path)?;
    let mut opening = RecordingOpening::new(path, described_in, defaults.clone())?;
    for surface in &folders {
        if surface.is_dir && !surface.is_hidden() {
            opening.surface(surface);
        } else if let Some(why) = surface.unusable {
            opening.headers.note(&surface.path, why);
        } else if let (false, Some(why)) = (surface.is_hidden(), surface.unreadable()) {
            opening.headers.note(&surface.path, why);
        }
    }
    if opening.trials.is_empty() && opening.bad.is_empty() {
        let files = folders.iter().filter(|item| item.is_series() && !item.is_hidden());
        opening.loose(UNLABELLED, &files.collect::<Vec<_>>());
    }
    Ok(opening.library())
}

/// Returns the library if it has trials, and otherwise an error that says why it has none.
fn something(path: &Path, opened: Opened) -> Result<Opened, LibraryError> {
    if !opened.library.entries.is_empty() {
        return Ok(opened);
    }
    let Opened { library: Library { scene, remarks, .. }, bad } = opened;
    let known = scene.sources().map(|s| s.id.as_str()).collect::<Vec<_>>().join(", ");
    let problem = format!(
        "no recordings found; looked for SURFACE/TRIAL/<source>.wav, .flac, .png or .jpg, where \
         <source> is one of {known}, for SURFACE/*.wav and *.wav, and for the LMT108 database (a folder that holds SoundScans/ or \
         AccelScansComponents/); name the folder that holds the surfaces' folders"
    );
    Err(nothing_found(path, bad, problem, &remarks))
}

/// Opens a single WAV or FLAC file as a library of one trial without a label.
pub(crate) fn open_file(path: &Path, defaults: &Scene) -> Result<Opened, LibraryError> {
    let path = path.canonicalize().map_err(|error| LibraryError::io(path, error))?;
    let (Some(folder), Some(item)) = (path.parent(), Listed::file(&path)) else {
        return Err(LibraryError::file(&path, "its name is not UTF-8; rename it"));
    };
    let mut opening = RecordingOpening::new(folder, folder, defaults.clone())?;
    opening.name.clone_from(&item.name);
    opening.loose(UNLABELLED, &[&item]);
    something(folder, opening.library())
}

/// Opens `LIBRARY/SURFACE/TRIAL` as a library of one trial, described by `LIBRARY/library.toml`.
pub fn open_trial(folder: &Path, defaults: &Scene) -> Result<Library, LibraryError> {
    let folder = folder.canonicalize().map_err(|error| LibraryError::io(folder, error))?;
    let (Some(surface), Some(item)) = (folder.parent(), Listed::folder(&folder)) else {
        return Err(LibraryError::file(&folder, "not the folder of a trial"));
    };
    let root = surface.parent().unwrap_or(surface);
    let mut opening = RecordingOpening::new(root, root, defaults.clone())?;
    let label = surface.file_name().unwrap_or_default().to_string_lossy();
    opening.trial(&label, &item);
    something(root, opening.library())?.whole()
}

/// A library entry for a trial in `files`; `folder` is the trial's own folder, if it has one.
pub(crate) fn entry(
    key: TrialKey,
    files: BTreeMap<SourceId, SourceFiles>,
    folder: Option<PathBuf>,
) -> Entry {
    let sources = files.keys().cloned().collect();
    Entry::new(key.clone(), sources, Arc::new(FileTrial { key, sources: files, folder }))
}

/// The error for a library of which nothing can be used: its `bad` files or, without any, the `problem`.
pub(crate) fn nothing_found(
    path: &Path,
    bad: Vec<LibraryError>,
    mut problem: String,
    remarks: &[String],
) -> LibraryError {
    remarks.iter().for_each(|remark| problem += &format!("\n  {remark}"));
    LibraryError::of_all(bad).unwrap_or_else(|| LibraryError::file(path, problem))
}

#[derive(Default)]
struct RecordingOpening {
    name: String,
    scene: Scene,
    declared: BTreeMap<SourceId, SourceBlock>,
    /// Sources without a described number of channels; their first recording gives it.
    unknown: BTreeSet<SourceId>,
    synthetic: bool,
    headers: Headers,
    trials: BTreeMap<TrialKey, (PathBuf, BTreeMap<SourceId, SourceFiles>)>,
    /// The words that names of trials without a person begin with, each with its surfaces.
    words: BTreeMap<String, BTreeSet<String>>,
    /// One error for each file or trial that cannot be used.
    bad: Vec<LibraryError>,
}

impl RecordingOpening {
    fn new(root: &Path, described_in: &Path, scene: Scene) -> Result<Self, LibraryError> {
        let headers = Headers::new(root, Remarks::default());
        let mut opening = Self { scene, headers, ..Self::default() };
        let described = described_in.join(DESCRIPTION);
        if let Some(text) = files::read_text_if_there(&described)? {
            let described =
                LibraryToml::parse(&text, &opening.scene).map_err(LibraryError::at(&described))?;
            opening.synthetic = described.synthetic;
            opening.declared = described.declared;
            opening.name.clone_from(&described.sources.name);
            let untold = opening.declared.iter().filter(|(id, block)| {
                block.channels.is_none() && opening.scene.get(id.as_str()).is_none()
            });
            opening.unknown = untold.map(|(id, _)| id.clone()).collect();
            opening.scene = opening.scene.with(described.sources);
        }
        Ok(opening)
    }

    fn library(self) -> Opened {
        let Self { mut name, scene, trials, words, headers, synthetic, bad, .. } = self;
        let mut remarks: Vec<String> = headers.remarks.lines().collect();
        let scene = scene.changed(|spec| {
            if let Some(rate_hz) = headers.lowest_hz.get(&spec.id) {
                spec.end_band_at(rate_hz / 2.0);
                remarks.push(format!(
                    "source `{}`: compared up to {} Hz, half of its lowest rate; to choose a band, \
                     say band_hz = [low, high] in library.toml",
                    spec.id,
                    rate_hz / 2.0
                ));
            }
        });
        let recurs = |(word, of): &(&String, &BTreeSet<String>)| !word.is_empty() && of.len() > 1;
        let words: Vec<_> = words.iter().filter(recurs).map(|(word, _)| word).collect();
        if let [one, other, ..] = words[..] {
            remarks.push(format!(
                "names of several surfaces' trials begin with `{one}` and `{other}`: if these are people, \
                 give each trial a folder, with `user = \"{one}\"` in its trial.toml; if they are \
                 surfaces, make them the outer folders"
            ));
        }
        let of = |(key, (path, files)): (TrialKey, (PathBuf, _))| {
            // `path` is the trial's folder or, for files outside a trial folder, the first file.
            let folder = path.is_dir().then_some(path);
            entry(key, files, folder)
        };
        let entries = trials.into_iter().map(of).collect();
        if name.is_empty() {
            let folder = headers.root.canonicalize().unwrap_or(headers.root);
            name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        }
        Opened { library: Library { name, scene, entries, synthetic, remarks }, bad }
    }

    fn surface(&mut self, surface: &Listed) {
        let items = match files::list(&surface.path) {
            Ok(items) => items,
            Err(error) => return self.bad.push(error),
        };
        let mut loose = Vec::new();
        for item in &items {
            let (stem, extension) = item.stem_and_extension();
            let why = if item.is_dir && item.name.ends_with(UNFINISHED) {
                Some("not used, it was never finished; remove the folder".to_string())
            } else if item.is_hidden() {
                None
            } else if let Some(why) = item.unusable {
                Some(why.into())
            } else if item.is_dir {
                self.trial(&surface.name, item);
                None
            } else if item.is_series() && self.scene.get(stem).is_none() {
                loose.push(item);
                None
            } else if item.has_series_name() || PICTURES.contains(&&*extension) {
                let expected = "expected SURFACE/TRIAL/<source>.wav";
                Some(format!("not used, it lies in no TRIAL folder; {expected}"))
            } else {
                item.unreadable()
            };
            why.into_iter().for_each(|why| self.headers.note(&item.path, why));
        }
        self.loose(&normal(&surface.name), &loose);
    }

    fn loose(&mut self, surface: &str, files: &[&Listed]) {
        let others = self.trials.keys().filter(|key| key.surface == surface && key.user == EXPERT);
        let taken: Vec<u32> = others.map(|key| key.number).collect();
        let only = self.declared.keys().next().filter(|_| self.declared.len() == 1);
        let usual = only.or_else(|| self.scene.get(USUAL).map(|spec| &spec.id)).cloned();
        let is_told = |name: &str| usual.is_some() || source_of(name, &self.scene).is_some();
        let (files, untold): (Vec<&Listed>, Vec<&Listed>) =
            files.iter().copied().partition(|item| is_told(item.stem_and_extension().0));
        for item in untold {
            let why = "not used, its name begins with no source; begin it with one, such as \
                       SOURCE_1.wav";
            self.headers.note(&item.path, why);
        }
        let names: Vec<&str> = files.iter().map(|item| item.stem_and_extension().0).collect();
        let places = loose_places(&names, &self.scene, usual.as_ref(), &taken);
        for (item, place) in files.iter().zip(places) {
            match self.series(&place.source, &item.path) {
                Err(error) => self.bad.push(error),
                Ok(file) => {
                    if place.guessed {
                        self.note_word(item.stem_and_extension().0, surface);
                        self.headers.note(&item.path, guessed_remark(&place.source));
                    }
                    let key = TrialKey::new(surface, EXPERT, place.number);
                    let trial = || (item.path.clone(), BTreeMap::new());
                    self.trials.entry(key).or_insert_with(trial).1.insert(place.source, file);
                }
            }
        }
    }

    fn note_word(&mut self, name: &str, surface: &str) {
        let word = name.trim_end_matches(|c: char| !c.is_alphabetic());
        self.words.entry(word.into()).or_default().insert(surface.into());
    }

    /// Checks that a file can be the data of a source of the scene.
    fn series(&mut self, id: &SourceId, path: &Path) -> Result<SourceFiles, LibraryError> {
        let spec = self.scene.get(id.as_str()).expect("a source of the scene");
        let declared = self.declared.get(id).cloned().unwrap_or_default();
        self.headers.series(spec, &declared, path)
    }

    fn trial(&mut self, surface: &str, folder: &Listed) {
        if let Err(error) = self.read_trial(surface, folder) {
            self.bad.push(error);
        }
    }

    fn read_trial(&mut self, surface: &str, folder: &Listed) -> Result<(), LibraryError> {
        let about = About::read(&folder.path)?;
        if about.incomplete {
            self.headers.note(&folder.path, "not used, trial.toml says incomplete = true");
            return Ok(());
        }
        let number = about.trial.or_else(|| number_in(&folder.name)).ok_or_else(|| {
            let problem = format!(
                "its name does not end with the number of the trial (0 to {}); rename it, for \
                 example to `trial1`, or say `trial = N` in its trial.toml. It holds a file of each source: \
                 several takes need a folder each, `trial1`, `trial2`, …",
                u32::MAX
            );
            LibraryError::file(&folder.path, problem)
        });
        let bad_files = self.bad.len();
        let mut sources = BTreeMap::new();
        for item in files::list(&folder.path)? {
            match self.source(&item, &folder.name) {
                Ok(Some((id, _))) if sources.contains_key(&id) => {
                    let problem =
                        format!("a second file for source `{id}` of this trial; remove one");
                    self.bad.push(LibraryError::file(&item.path, problem));
                }
                Ok(Some((id, files))) => drop(sources.insert(id, files)),
                Ok(None) => {}
                Err(error) => self.bad.push(error),
            }
        }
        if sources.is_empty() {
            if self.bad.len() == bad_files {
                self.headers.note(&folder.path, "not used, it holds no file of any source");
            }
            return Ok(());
        }
        if about.user.is_none() {
            self.note_word(&folder.name, surface);
        }
        let key = TrialKey {
            surface: about.surface.unwrap_or_else(|| normal(surface)),
            user: about.user.unwrap_or_else(|| EXPERT.to_string()),
            number: number?,
            session: about.session,
        };
        self.synthetic |= about.synthetic;
        if let Some((other, _)) = self.trials.get(&key) {
            let problem = format!(
                "the same trial ({key}) as {}; distinguish them by `trial = N`, `user = \"…\"` or \
                 `session = \"…\"` in trial.toml, or remove one",
                other.strip_prefix(&self.headers.root).unwrap_or(other).display()
            );
            return Err(LibraryError::file(&folder.path, problem));
        }
        self.trials.insert(key, (folder.path.clone(), sources));
        Ok(())
    }

    /// Takes the number of channels of an undescribed source from the source's first recording.
    fn learn(&mut self, id: SourceId, path: &Path) -> Result<(), LibraryError> {
        let header = series_file::probe(path)?;
        if self.scene.get(id.as_str()).is_none() {
            let (channels, rate_hz) = (counted(header.channels, "channel"), header.rate_hz);
            let mut what = format!(
                "no source is called `{id}`, so it is taken as a series of {channels} at {rate_hz} Hz; \
                 [sources.{id}] in {DESCRIPTION} can say more"
            );
            if id.as_str().bytes().all(|byte| byte.is_ascii_digit()) {
                what += "; if the numbers are those of takes, give each take a folder of its own";
            }
            self.headers.note(path, what);
        }
        self.scene.set_channels(id, header.channels);
        Ok(())
    }

    /// The source that a file of a trial in the folder `folder` holds; `None` if the file is not used.
    fn source(
        &mut self,
        item: &Listed,
        folder: &str,
    ) -> Result<Option<(SourceId, SourceFiles)>, LibraryError> {
        let (stem, extension) = item.stem_and_extension();
        // Recorders name the files of a take after its folder, such as `ZOOM0001_LR` in `ZOOM0001`.
        let rest = stem.strip_prefix(folder).and_then(|rest| rest.strip_prefix(['_', '-', ' ']));
        let stem = rest.filter(|rest| !rest.is_empty()).unwrap_or(stem);
        let is_series = item.has_series_name();
        let picture = PICTURES.contains(&extension.as_str());
        if item.is_hidden() || item.is_dir {
            return Ok(None);
        }
        if let Some(why) = item.unusable.map(String::from).or_else(|| item.unreadable()) {
            self.headers.note(&item.path, why);
            return Ok(None);
        }
        if !(picture || is_series) {
            return Ok(None);
        }
        if !picture
            && let Ok(id) = SourceId::new(stem)
            && (self.unknown.remove(&id) || self.scene.get(stem).is_none())
        {
            self.learn(id, &item.path)?;
        }
        let Some(spec) = self.scene.get(stem) else {
            let what = match SourceId::new(stem) {
                Err(error) => format!("not used: {error}; rename the file"),
                Ok(id) => format!(
                    "not used, since no source is called `{id}`; to use it, add to {DESCRIPTION}: \
                     [sources.{id}] domain = \"image\", channels = 3"
                ),
            };
            self.headers.note(&item.path, what);
            return Ok(None);
        };
        let id = spec.id.clone();
        if picture && spec.domain != Domain::Image {
            let problem = format!("a picture, but source `{stem}` is not; expected {stem}.wav");
            return Err(LibraryError::file(&item.path, problem));
        }
        if picture {
            return Ok(Some((id, SourceFiles::Picture(item.path.clone()))));
        }
        let files = self.series(&id, &item.path)?;
        Ok(Some((id, files)))
    }
}

/// The default source of a file, if neither the file's name nor `library.toml` selects another.
const USUAL: &str = "mi2";

#[derive(Clone, Debug, PartialEq)]
struct FilePlace {
    source: SourceId,
    number: u32,
    /// Whether the file's name does not begin with the name of a source.
    guessed: bool,
}

/// The source and the trial number of each file in `names` (without extension), in order. `usual` is the
/// source of a name that begins with none; numbers in `taken` belong to other trials. The number is the
/// one at the end of the name, if every name ends with a free number and no source has a number twice.
/// If not, the files are numbered in the order of their names.
fn loose_places(
    names: &[&str],
    scene: &Scene,
    usual: Option<&SourceId>,
    taken: &[u32],
) -> Vec<FilePlace> {
    let place = |name: &&str| {
        let (named, number) = (source_of(name, scene), number_in(name).unwrap_or_default());
        let guessed = named.is_none();
        Some(FilePlace { source: named.or_else(|| usual.cloned())?, number, guessed })
    };
    let mut places: Vec<FilePlace> = names.iter().filter_map(place).collect();
    let free = |name: &&str| number_in(name).is_some_and(|number| !taken.contains(&number));
    let different: BTreeSet<_> = places.iter().map(|place| (&place.source, place.number)).collect();
    if different.len() < names.len() || !names.iter().all(free) {
        let first = taken.iter().max().map_or(1, |most| most.saturating_add(1));
        let mut next: BTreeMap<SourceId, u32> = BTreeMap::new();
        for place in &mut places {
            let next = next.entry(place.source.clone()).or_insert(first);
            place.number = *next;
            *next = next.saturating_add(1);
        }
    }
    places
}

/// The remark on files that were read as `source`, since their names begin with no source's name.
fn guessed_remark(source: &SourceId) -> String {
    let what = if source.as_str() == USUAL { "sound of a drag" } else { "the source" };
    format!("read as {what} (`{source}`); begin the file name with another source to change that")
}

/// The source that `name` begins with, if no letter or digit follows; of several, the longest.
fn source_of(name: &str, scene: &Scene) -> Option<SourceId> {
    let begins = |id: &str| {
        let rest = name.strip_prefix(id)?;
        Some(!rest.starts_with(char::is_alphanumeric))
    };
    let longest = scene.sources().filter(|spec| begins(spec.id.as_str()) == Some(true));
    longest.max_by_key(|spec| spec.id.as_str().len()).map(|spec| spec.id.clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn placed(names: &[&str], taken: &[u32]) -> Vec<(String, u32)> {
        let usual = SourceId::new(USUAL).unwrap();
        let places = loose_places(names, &Scene::lmt108(), Some(&usual), taken);
        places.iter().map(|place| (place.source.to_string(), place.number)).collect()
    }

    #[test]
    fn names_say_source_and_number_where_they_can() {
        let of = |name: &str, number| (name.to_string(), number);
        assert_eq!(placed(&["scan 3", "scan 12"], &[]), [of("mi2", 3), of("mi2", 12)]);
        assert_eq!(placed(&["ac_1", "mi2-1"], &[]), [of("ac", 1), of("mi2", 1)]);
        assert_eq!(placed(&["ac"], &[]), [of("ac", 1)]);
        assert_eq!(placed(&["acorn1", "first"], &[]), [of("mi2", 1), of("mi2", 2)]);
        assert_eq!(placed(&["a1", "b1"], &[]), [of("mi2", 1), of("mi2", 2)], "one number twice");
        assert_eq!(placed(&["scan1", "scan2"], &[1]), [of("mi2", 2), of("mi2", 3)]);
    }
}
