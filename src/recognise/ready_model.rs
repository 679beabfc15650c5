//! Makes the model of a library: reads it from the cache if nothing has changed, else trains it.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use super::error::RecogniseError;
use super::method::{Method, Model};
use super::prepared_library::prepare_for;
use super::shape::LibraryShape;
use crate::library::Entry;
use crate::library::cache::{Cache, Record};
use crate::library::files::program_stamp;
use crate::seed;

/// Name of the only record in the cache.
const RECORD: &str = "model";

/// A model, and whether it came from the cache.
pub struct ReadyModel {
    /// The model.
    pub model: Arc<dyn Model>,
    /// Whether it came from the cache.
    pub from_cache: bool,
    /// Problems with the caches, one line of text each; the model is usable all the same.
    pub remarks: Vec<String>,
}

/// Makes a model of those `entries` whose indices are in `wanted`. `beside` is the folder of the
/// library; the caches there are read and updated: that of models (`METHOD-model`), then that of
/// prepared trials, see [`super::prepare_library`]. Without `beside`, all is computed anew.
/// `progress` is called with the number of trials prepared so far and their total.
///
/// The result is the same with and without a cache: a stored model is used only if the method, the
/// files of all trials and this program are unchanged.
///
/// # Errors
/// If a trial cannot be read or does not fit the scene; also the errors of [`Method::fit`].
pub fn ready_model(
    method: &dyn Method,
    entries: &[Entry],
    wanted: &BTreeSet<usize>,
    beside: Option<&Path>,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<ReadyModel, RecogniseError> {
    let of_model: Vec<&Entry> = wanted.iter().map(|&i| &entries[i]).collect();
    let shape = Arc::new(LibraryShape::of(&of_model)?);
    let kept = beside.and_then(|folder| Kept::open(method, &of_model, &shape, folder));
    if let Some(model) = kept.as_ref().and_then(|kept| kept.model(method, &shape)) {
        return Ok(ReadyModel { model, from_cache: true, remarks: Vec::new() });
    }
    let prepared = prepare_for(method, shape.clone(), (entries, wanted), beside, progress)?;
    let mut remarks = prepared.remarks;
    // Moved, not borrowed, so that the method can free what it has used.
    let model = method.fit(prepared.trials.into_iter().flatten().collect(), &prepared.shape)?;
    // A model whose trials' files have changed meanwhile is used, but not stored.
    if let Some(kept) = kept.filter(|kept| stamp(&of_model) == Some(kept.stamp))
        && let Some(bytes) = model.clone().embedding().and_then(|model| model.store())
    {
        let why = kept.replace(bytes.into());
        // If the trials could not be stored either, a remark already says so.
        if remarks.is_empty() {
            remarks.extend(why);
        }
    }
    Ok(ReadyModel { model, from_cache: false, remarks })
}

/// Hash of the names and files of some trials as they are now.
fn stamp(entries: &[&Entry]) -> Option<u64> {
    let trial = |entry: &&Entry| {
        let mut name = entry.cache_name().into_bytes();
        name.extend(entry.stamp()?.to_le_bytes());
        Some(name)
    };
    let trials: Vec<Vec<u8>> = entries.iter().map(trial).collect::<Option<_>>()?;
    Some(seed::stable_hash(&trials.iter().map(Vec::as_slice).collect::<Vec<_>>()))
}

/// The cache that holds the model of a library.
struct Kept {
    cache: Cache,
    /// Hash of the trials that the model is made of, as `stamp` gives it.
    stamp: u64,
}

impl Kept {
    /// Opens the cache; `None` if models of this method or of these trials are not stored.
    fn open(
        method: &dyn Method,
        entries: &[&Entry],
        shape: &LibraryShape,
        folder: &Path,
    ) -> Option<Self> {
        // Another build of the program may make another model of the same trials.
        let key = [method.model_key(shape)?, program_stamp()?].map(u64::to_le_bytes);
        let key = seed::stable_hash(&[&key[0], &key[1]]);
        let stamp = stamp(entries)?;
        // A problem with this cache needs no remark: the file is written again.
        let (cache, _) = Cache::open(folder, &format!("{}-model", method.name()), key);
        Some(Self { cache, stamp })
    }

    fn model(&self, method: &dyn Method, shape: &Arc<LibraryShape>) -> Option<Arc<dyn Model>> {
        method.restore(&self.cache.get(RECORD, self.stamp)?, shape)
    }

    fn replace(self, bytes: std::borrow::Cow<'_, [u8]>) -> Option<String> {
        self.cache.replace(&[Record { name: RECORD.into(), stamp: self.stamp, bytes }])
    }
}
