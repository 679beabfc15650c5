//! A library made ready to be compared with: from its cache where that holds, else from its files.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::error::RecogniseError;
use super::method::Method;
use crate::library::Entry;
use crate::library::cache::{Cache, Record};

/// A prepared library.
pub struct Preparation<P> {
    /// Those of the trials that were wanted, at the places of their entries.
    pub trials: Vec<Option<Arc<P>>>,
    /// For people: what was wrong with the cache, a line each. Nothing of it is an error.
    pub remarks: Vec<String>,
    /// How many trials came from the cache.
    pub from_cache: usize,
}

/// Prepares the `wanted` ones of `entries`, by index. `beside` is the folder of the library, whose
/// cache is read and brought up to date; without it, all is prepared anew. `progress` is told how
/// much is done of how much.
///
/// What comes of it is the same with and without a cache: a stored trial counts only if the method's
/// settings and the sizes and times of its files are what they were.
///
/// # Errors
/// If a trial cannot be read, or does not fit the scene.
pub fn prepare_library<M: Method>(
    method: &M,
    entries: &[Entry],
    wanted: &BTreeSet<usize>,
    beside: Option<&Path>,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<Preparation<M::Prepared>, RecogniseError> {
    let mut remarks = Vec::new();
    let cache = beside.zip(method.storage_key()).map(|(folder, key)| {
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
        let stored = cache.as_ref().and_then(|cache| {
            let bytes = cache.get(&entry.cache_name(), entry.stamp()?)?;
            method.restore(entry, bytes)
        });
        let prepared = match stored {
            Some(prepared) => {
                from_cache.fetch_add(1, Ordering::Relaxed);
                prepared
            }
            None => method.prepare_for_library(entry, &entry.load()?)?,
        };
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, wanted.len());
        Ok(Some(Arc::new(prepared)))
    };
    let trials: Vec<Option<Arc<M::Prepared>>> =
        (0..entries.len()).into_par_iter().map(prepare).collect::<Result<_, RecogniseError>>()?;
    let from_cache = from_cache.into_inner();
    if let Some(cache) = cache
        && from_cache < wanted.len()
    {
        let records: Vec<Record<'_>> = entries
            .par_iter()
            .zip(&trials)
            .filter_map(|(entry, prepared)| {
                let (name, stamp) = (entry.cache_name(), entry.stamp()?);
                // A trial that was not wanted this time stays, if it still is what it was.
                let bytes = match prepared {
                    Some(prepared) => method.store(prepared).into(),
                    None => cache.get(&name, stamp)?.into(),
                };
                Some(Record { name, stamp, bytes })
            })
            .collect();
        if !records.is_empty() {
            remarks.extend(cache.replace(&records));
        }
    }
    Ok(Preparation { trials, remarks, from_cache })
}
