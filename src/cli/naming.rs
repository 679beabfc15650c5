//! Recognisers, which name scans: by a library, or by a model file.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use super::choose::within;
use super::condition::WhereArgs;
use super::method::{AccuracyArgs, AnswerArgs, Comparing, Lasting};
use super::show::{listed, summary};
use super::{Done, Failure, bad_files, say};
use crate::library::{Entry, Library};
use crate::recognise::{Model, ModelFile, RejectionError, ready_model};
use crate::record::edit::LibraryLock;
use crate::record::reference::references;
use crate::scene::{Scene, SourceId};
use crate::serve::Audit;
use crate::station::{LibraryState, Load, Recogniser};

/// A recogniser, ready to name scans.
pub(super) struct Ready {
    pub by: Recogniser,
    /// Whether it follows scans in progress.
    pub follows: bool,
    lasting: Option<String>,
}

impl Ready {
    /// Makes a recogniser answer as these options say. Its remarks then say what its answers are based on.
    pub(super) fn new(
        mut by: Recogniser,
        answers: &AnswerArgs,
        (needed_s, lasting): Lasting,
    ) -> Result<Self, RejectionError> {
        by.needed_s = needed_s;
        let follows = answers.apply(&mut by)?;
        by.library.remarks.extend(lasting.clone());
        Ok(Self { by, follows, lasting })
    }

    /// Prints how long scans must last; with `--verbose`, all that the answers are based on.
    pub(super) fn say(&self) {
        match say::is_verbose() {
            true => self.by.library.remarks.iter().for_each(|remark| say!("{remark}")),
            false => self.lasting.iter().for_each(|line| say!("{line}")),
        }
    }
}

/// Opens a model file, ready to name scans, and says what it holds. `given` are the sources that scans can
/// have, if they are known.
pub(super) fn open_model(
    path: &Path,
    (answers, accuracy): (&AnswerArgs, &AccuracyArgs),
    given: Option<&BTreeSet<SourceId>>,
) -> Done<(Ready, ModelFile)> {
    let file = ModelFile::read(path).map_err(|error| Failure::at(path, error))?;
    let trials = file.surfaces.iter().map(|(_, trials)| trials).sum();
    let what = summary(&file.library, file.is_synthetic, trials, file.surfaces.len());
    say!("{what}, a model by surfaced {}, library {}", file.program, file.digest);
    if let Some(given) = given {
        check_given(path, &file.sources, given)?;
        if let Some(embedding) = file.model.clone().embedding() {
            embedding.ready_for(given);
        }
    }
    let lasting = match accuracy.is_given() {
        true => accuracy.lasting(&file.model)?,
        false => (file.scan_s, file.scan_s_why.clone()),
    };
    let state = LibraryState {
        name: file.library.clone(),
        surfaces: file.surfaces.clone(),
        sources: file.sources.clone(),
        synthetic: file.is_synthetic,
        ..LibraryState::default()
    };
    let by = Recogniser::new(file.model.clone(), file.scene.clone(), state);
    Ok((Ready::new(by, answers, lasting)?, file))
}

/// The trained model of a library, with the part of the library that it compares.
pub(super) struct Trained {
    pub scene: Scene,
    pub entries: Vec<Entry>,
    pub state: LibraryState,
    pub model: Arc<dyn Model>,
}

/// Trains the model of an open library at `path`, or takes it from the cache. If `given`, the sources that
/// scans can have, are known, the library must have one of them.
pub(super) fn trained(
    path: &Path,
    library: &Library,
    how: &Comparing,
    given: Option<&BTreeSet<SourceId>>,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Done<Trained> {
    let scene = how.narrow(library.scene.clone())?;
    let entries = within(library, &scene)?;
    let state = LibraryState::of(&library.name, &entries, library.synthetic);
    if let Some(given) = given {
        check_given(path, &state.sources, given)?;
    }
    let all = (0..entries.len()).collect();
    let (method, cache) = (how.method.build(&scene), how.cache_in(path));
    let ready = ready_model(&*method, &entries, &all, cache.as_deref(), progress)?;
    ready.remarks.iter().for_each(|remark| say!("{remark}"));
    Ok(Trained { scene, entries, state, model: ready.model })
}

/// Returns a function that reads the library each time it is called, and prepares it for naming.
/// `given` are the sources that scans can have, if they are known. Without begin and end
/// (`is_continuous`), a library whose scan time is not known is refused.
pub(super) fn load(
    path: &Path,
    scene: &Scene,
    how: &Comparing,
    (answers, accuracy): (&AnswerArgs, &AccuracyArgs),
    given: Option<BTreeSet<SourceId>>,
    is_continuous: bool,
) -> Load {
    let (path, scene) = (path.to_path_buf(), scene.clone());
    let (how, answers, accuracy) = (how.clone(), answers.clone(), accuracy.clone());
    Arc::new(move || {
        let _lock = LibraryLock::for_reading(&path);
        let library = bad_files::open(&path, &scene).map_err(Failure::text)?;
        let ready = bad_files::work(&path, library, |library| {
            trained(&path, library, &how, given.as_ref(), &|_, _| {})
        });
        let Trained { scene, entries, mut state, model } = ready.map_err(Failure::text)?;
        state.reference = references(&path).map_err(|error| error.to_string())?;
        if let (Some(given), Some(embedding)) = (&given, model.clone().embedding()) {
            // Devices of the library may be missing here; training must not wait for the first drag.
            embedding.ready_for(given);
        }
        let lasting = how.lasting(&accuracy, &model).map_err(Failure::text)?;
        let by = Recogniser::new(model, scene, state).with_trials(&entries);
        let mut by = Ready::new(by, &answers, lasting).map_err(|error| error.to_string())?.by;
        by.library.remarks.extend(bad_files::skipped());
        if is_continuous {
            has_scan_time(&by)?;
        }
        Ok(Arc::new(by))
    })
}

/// Refuses a library whose scan time is not known, for naming without begin and end.
pub(super) fn has_scan_time(by: &Recogniser) -> Result<(), String> {
    by.needed_s.map(drop).ok_or_else(|| {
        "naming without begin and end needs the scan time that the library requires, which is not known: \
         record more trials of each surface, and use the method `embedding`"
            .into()
    })
}

/// Returns a function that audits the library each time it is called.
pub(super) fn check(path: &Path, how: &Comparing) -> Audit {
    let (path, how) = (path.to_path_buf(), how.clone());
    Arc::new(move || {
        let all = WhereArgs::default();
        let (report, _) =
            super::check::audit(&path, &how, &all, &|_, _, _| {}).map_err(Failure::text)?;
        Ok(report)
    })
}

/// Checks that the station's devices give at least one of the sources of the library or model at `path`.
fn check_given(path: &Path, sources: &[SourceId], given: &BTreeSet<SourceId>) -> Done<()> {
    if sources.iter().any(|source| given.contains(source)) {
        return Ok(());
    }
    let live = match cfg!(all(feature = "microphone", feature = "camera")) {
        true => "",
        false => " (for sound and pictures, build with `--features live`)",
    };
    Err(Failure::Failed(format!(
        "{}: it has {}, but the devices of this station give {}, so no scan can be named; record \
         a library with these devices (`surfaced enroll LABEL`), or configure the devices that it \
         was recorded with{live}",
        path.display(),
        listed(sources),
        listed(given),
    )))
}
