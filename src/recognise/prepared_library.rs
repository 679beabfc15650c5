//! A library made ready to be compared with: from its cache where that holds, else from its files.

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
    /// Those of the trials that were wanted, at the places of their entries.
    pub trials: Vec<Option<Prepared>>,
    /// Problems of the cache, a line of text each. None is an error.
    pub remarks: Vec<String>,
    /// How many trials came from the cache.
    pub from_cache: usize,
}

impl PreparedLibrary {
    /// A model of some of the trials, by their places; those that were not wanted are passed over.
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

/// Prepares the `wanted` ones of `entries`, by index, for a library of the shape that they have.
/// `beside` is the folder of the library, whose cache is read and brought up to date; without it,
/// all is prepared anew. `progress` gets how much is done of how much.
///
/// The result is the same with and without a cache: a stored trial counts only if the method's
/// settings and the trial's files are what they were. One whose files change while they are read is
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

/// As [`prepare_library`], for a shape that is known.
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
                // A trial that was not wanted this time stays, if it still is what it was.
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
