//! Prepares the trials of a library and makes its model, or reads both from caches that are still up
//! to date.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::error::Result;
use super::method::{Method, Model};
use super::prepared::{FORMAT, Prepared};
use crate::library::Entry;
use crate::library::cache::{Cache, Record};
use crate::library::files::program_stamp;
use crate::library::shape::LibraryShape;
use crate::seed;

const RECORD: &str = "model";

pub struct PreparedLibrary {
    pub shape: Arc<LibraryShape>,
    /// For each entry, its prepared trial; `None` if the entry was not wanted.
    pub trials: Vec<Option<Prepared>>,
    /// Problems with the cache, one line of text each. The trials can be used in spite of them.
    pub remarks: Vec<String>,
    pub from_cache: usize,
}

impl PreparedLibrary {
    /// Fits a model to the trials at the given indices; skips trials that were not prepared.
    ///
    /// # Errors
    /// The errors of [`Method::fit`].
    pub fn fit<'a>(
        &self,
        method: &dyn Method,
        trials: impl IntoIterator<Item = &'a usize>,
    ) -> Result<Arc<dyn Model>> {
        let library = trials.into_iter().filter_map(|&i| self.trials[i].clone()).collect();
        method.fit(library, &self.shape)
    }
}

/// Prepares the `entries` with indices in `wanted`, for a library of the shape of these entries.
/// `beside` is the folder of the library; its cache is read and updated. If `beside` is `None`, every
/// trial is prepared anew. `progress` is called with the number of trials done and their total.
///
/// The cache does not change the result: a stored trial is used only if the method's settings and the
/// trial's files are unchanged. If the files of a trial change while they are read, the trial is not
/// stored.
///
/// # Errors
/// If a trial cannot be read, or does not fit the scene.
pub fn prepare_library(
    method: &dyn Method,
    entries: &[Entry],
    wanted: &BTreeSet<usize>,
    beside: Option<&Path>,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<PreparedLibrary> {
    let shape = LibraryShape::of(&wanted.iter().map(|&i| &entries[i]).collect::<Vec<_>>())?;
    prepare_for(method, Arc::new(shape), (entries, wanted), beside, progress)
}

/// Does the work of [`prepare_library`] for a known shape.
fn prepare_for(
    method: &dyn Method,
    shape: Arc<LibraryShape>,
    (entries, wanted): (&[Entry], &BTreeSet<usize>),
    beside: Option<&Path>,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<PreparedLibrary> {
    let mut remarks = Vec::new();
    let cache = beside.map(|folder| {
        let key = [FORMAT, method.settings_key(&shape)].map(u64::to_le_bytes);
        let key = seed::stable_hash(&[&key[0], &key[1]]);
        let (cache, remark) = Cache::open(folder, method.name(), key);
        remarks.extend(remark);
        cache
    });
    let (done, from_cache) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let prepare = |i: usize| {
        if !wanted.contains(&i) {
            return Ok(None);
        }
        let entry = &entries[i];
        let before = entry.stamp();
        let stored = cache
            .as_ref()
            .and_then(|cache| Prepared::decode(entry, &cache.get(&entry.cache_name(), before?)?));
        let prepared = match stored {
            Some(prepared) => {
                from_cache.fetch_add(1, Ordering::Relaxed);
                prepared
            }
            None => method.prepare(entry, &entry.load()?, &shape)?,
        };
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, wanted.len());
        Ok(Some((prepared, before.filter(|_| before == entry.stamp()))))
    };
    let trials: Vec<Option<(Prepared, Option<u64>)>> =
        (0..entries.len()).into_par_iter().map(prepare).collect::<Result<_>>()?;
    let from_cache = from_cache.into_inner();
    if let Some(cache) = cache
        && from_cache < wanted.len()
    {
        let record = |cache: &Cache, i: usize| {
            let name = entries[i].cache_name();
            // An entry that is not wanted this time stays in the cache if its files are unchanged.
            let (stamp, bytes) = match &trials[i] {
                Some((prepared, stamp)) => ((*stamp)?, prepared.encode()?),
                None => {
                    let stamp = entries[i].stamp()?;
                    (stamp, cache.get(&name, stamp)?)
                }
            };
            Some(Record { name, stamp, bytes })
        };
        remarks.extend(cache.replace(entries.len(), record));
    }
    let trials = trials.into_iter().map(|prepared| Some(prepared?.0)).collect();
    Ok(PreparedLibrary { shape, trials, remarks, from_cache })
}

pub struct ReadyModel {
    pub model: Arc<dyn Model>,
    pub from_cache: bool,
    /// Problems with the caches, one line of text each. The model can be used in spite of them.
    pub remarks: Vec<String>,
}

/// Makes a model of the `entries` with indices in `wanted`. `beside` is the folder of the library. Its
/// cache of models (`METHOD-model`) and its cache of prepared trials (see [`prepare_library`]) are
/// read and updated. If `beside` is `None`, everything is computed anew. `progress` is called with the
/// number of trials prepared so far and their total.
///
/// The caches do not change the result: a stored model is used only if the method, the files of all
/// trials and this program are unchanged.
///
/// # Errors
/// If a trial cannot be read or does not fit the scene, and the errors of [`Method::fit`].
pub fn ready_model(
    method: &dyn Method,
    entries: &[Entry],
    wanted: &BTreeSet<usize>,
    beside: Option<&Path>,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<ReadyModel> {
    let of_model: Vec<&Entry> = wanted.iter().map(|&i| &entries[i]).collect();
    let shape = Arc::new(LibraryShape::of(&of_model)?);
    let kept = beside.and_then(|folder| {
        // Another build of the program may make a different model of the same trials.
        let key = [method.model_key(&shape)?, program_stamp()?].map(u64::to_le_bytes);
        let key = seed::stable_hash(&[&key[0], &key[1]]);
        let stamp = stamp(&of_model)?;
        // A problem with this cache needs no remark, since the file is written again below.
        Some((Cache::open(folder, &format!("{}-model", method.name()), key).0, stamp))
    });
    let stored = kept.as_ref().and_then(|(cache, stamp)| cache.get(RECORD, *stamp));
    if let Some(model) = stored.and_then(|bytes| method.restore(&bytes, &shape)) {
        return Ok(ReadyModel { model, from_cache: true, remarks: Vec::new() });
    }
    let prepared = prepare_for(method, shape, (entries, wanted), beside, progress)?;
    let mut remarks = prepared.remarks;
    // The trials are moved, not borrowed, so that the method can free trials it has used.
    let model = method.fit(prepared.trials.into_iter().flatten().collect(), &prepared.shape)?;
    let embedding = model.clone().embedding();
    if let Some(embedding) = &embedding {
        embedding.ready_for_length(Some(0.0));
    }
    // If files of the trials have changed meanwhile, the model is used but not stored.
    if let Some((cache, of_files)) = kept.filter(|kept| stamp(&of_model) == Some(kept.1))
        && let Some(embedding) = embedding
    {
        let why = cache.replace(1, |_, _| {
            Some(Record { name: RECORD.into(), stamp: of_files, bytes: embedding.store()? })
        });
        // If the trials could not be stored, there is a remark already.
        if remarks.is_empty() {
            remarks.extend(why);
        }
    }
    Ok(ReadyModel { model, from_cache: false, remarks })
}

/// Hash of the names and current files of some trials; `None` if a file cannot be read.
fn stamp(entries: &[&Entry]) -> Option<u64> {
    let trial = |entry: &&Entry| {
        let mut name = entry.cache_name().into_bytes();
        name.extend(entry.stamp()?.to_le_bytes());
        Some(name)
    };
    let trials: Vec<Vec<u8>> = entries.iter().map(trial).collect::<Option<_>>()?;
    Some(seed::stable_hash(&trials.iter().map(Vec::as_slice).collect::<Vec<_>>()))
}
