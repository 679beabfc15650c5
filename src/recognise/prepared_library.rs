//! Prepares the trials of a library, or takes them from the cache where that is up to date.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::error::RecogniseError;
use super::method::{Method, Model};
use super::prepared::{FORMAT, Prepared};
use super::shape::LibraryShape;
use crate::library::Entry;
use crate::library::cache::{Cache, Record};
use crate::seed;

/// A prepared library.
pub struct PreparedLibrary {
    /// The shape that its trials were prepared for.
    pub shape: Arc<LibraryShape>,
    /// The prepared trials at the indices of their entries; `None` for those that were not wanted.
    pub trials: Vec<Option<Prepared>>,
    /// Problems with the cache, one line of text each; the trials are usable all the same.
    pub remarks: Vec<String>,
    /// How many trials came from the cache.
    pub from_cache: usize,
}

impl PreparedLibrary {
    /// Makes a model of the trials at the given indices; skips those that were not prepared.
    ///
    /// # Errors
    /// As [`Method::fit`].
    pub fn fit<'a>(
        &self,
        method: &dyn Method,
        trials: impl IntoIterator<Item = &'a usize>,
    ) -> Result<Arc<dyn Model>, RecogniseError> {
        let library = trials.into_iter().filter_map(|&i| self.trials[i].clone()).collect();
        method.fit(library, &self.shape)
    }
}

/// Prepares those `entries` whose indices are in `wanted`, for a library of the shape that these
/// have. `beside` is the folder of the library, whose cache is read and updated; without `beside`,
/// all is computed anew. `progress` is called with the number of trials done and their total.
///
/// The result is the same with and without a cache: a stored trial is used only if the method's
/// settings and the trial's files are unchanged. A trial whose files change while they are read is
/// not stored.
///
/// # Errors
/// If a trial cannot be read, or does not fit the scene.
pub fn prepare_library(
    method: &dyn Method,
    entries: &[Entry],
    wanted: &BTreeSet<usize>,
    beside: Option<&Path>,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<PreparedLibrary, RecogniseError> {
    let shape = LibraryShape::of(&wanted.iter().map(|&i| &entries[i]).collect::<Vec<_>>())?;
    prepare_for(method, Arc::new(shape), (entries, wanted), beside, progress)
}

/// As [`prepare_library`], for a known shape.
pub(super) fn prepare_for(
    method: &dyn Method,
    shape: Arc<LibraryShape>,
    (entries, wanted): (&[Entry], &BTreeSet<usize>),
    beside: Option<&Path>,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<PreparedLibrary, RecogniseError> {
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
        (0..entries.len()).into_par_iter().map(prepare).collect::<Result<_, RecogniseError>>()?;
    let from_cache = from_cache.into_inner();
    if let Some(cache) = cache
        && from_cache < wanted.len()
    {
        let records: Vec<Record<'_>> = entries
            .par_iter()
            .zip(&trials)
            .filter_map(|(entry, prepared)| {
                let name = entry.cache_name();
                // A trial that was not wanted this time stays stored if its files are unchanged.
                let (stamp, bytes) = match prepared {
                    Some((prepared, stamp)) => ((*stamp)?, prepared.encode()?.into()),
                    None => {
                        let stamp = entry.stamp()?;
                        (stamp, cache.get(&name, stamp)?.into())
                    }
                };
                Some(Record { name, stamp, bytes })
            })
            .collect();
        if !records.is_empty() {
            remarks.extend(cache.replace(&records));
        }
    }
    let trials = trials.into_iter().map(|prepared| Some(prepared?.0)).collect();
    Ok(PreparedLibrary { shape, trials, remarks, from_cache })
}
