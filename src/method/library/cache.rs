//! The two cache files of a library for one method, which make the next start fast. One holds the
//! trials, prepared by the method for comparison. The other holds the model trained on the trials.
//!
//! Caches are hidden files, `LIBRARY/.METHOD.surfaced-cache` and `LIBRARY/.METHOD-model.surfaced-cache`.
//! A cache is replaced as a whole, and may be removed at any time. Its format, little-endian:
//!
//! ```text
//! "surfaced cache"  version u16   key u64
//! records:  name length u32   name   stamp u64   length u64   bytes   CRC-32 of the record u32
//! ```
//! `key` identifies the settings that the trials were prepared with. `stamp` identifies the files
//! that a record was made from (by device, inode, size and times of change): the files of one trial
//! or, for a model, of all trials. A damaged record counts as missing, and causes at most a remark.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rayon::prelude::*;

use super::files;
use crate::system::{persist, read_exact_at};

const MAGIC: &[u8; 14] = b"surfaced cache";
/// Version of the file format. Increase it with each change to the content or encoding of records.
const VERSION: u16 = 3;
const HEADER: usize = MAGIC.len() + 2 + 8;
const CHECKSUM: u64 = 4;
/// Longest name of a record, in bytes. A name consists of a surface, a user and a trial number.
const LONGEST_NAME: u32 = 1 << 16;
/// Number of records in memory at a time while a cache is written.
const AT_ONCE: usize = 32;
/// Suffix of a file that is still being written. The writing program holds a lock on the file.
const UNFINISHED: &str = ".unfinished";
/// Age from which an unfinished, unlocked file is removed: the program that wrote it was killed.
const ABANDONED: Duration = Duration::from_secs(60);

/// An open cache file. The bytes of a record are read on demand.
#[derive(Debug)]
pub struct Cache {
    path: PathBuf,
    key: u64,
    /// `None` if no file is usable. An open file stays valid: writers replace it as a whole.
    file: Option<File>,
    records: BTreeMap<String, Place>,
}

#[derive(Clone, Copy, Debug)]
struct Place {
    stamp: u64,
    /// Byte of the file where the record's data begin. Their checksum follows after `length` bytes.
    begin: u64,
    length: u64,
}

#[derive(Clone)]
pub(crate) struct Record {
    pub name: String,
    /// Identifies the files that the record was prepared from.
    pub stamp: u64,
    pub bytes: Vec<u8>,
}

impl Cache {
    /// Opens the cache of a method in a library's folder. A file of another version or with another
    /// key counts as empty. The returned text says why an existing file cannot be used.
    pub fn open(library: &Path, method: &str, key: u64) -> (Self, Option<String>) {
        let path = library.join(format!(".{method}.surfaced-cache"));
        let mut cache = Self { path, key, file: None, records: BTreeMap::new() };
        let error = cache.read().err().filter(|error| error.kind() != io::ErrorKind::NotFound);
        let path = cache.path.display();
        let remark = error.map(|why| format!("{path}: {why}; the library is prepared anew"));
        (cache, remark)
    }

    /// Finds the records of a file with this key; those found before an error can still be used.
    fn read(&mut self) -> io::Result<()> {
        let (mut file, length) = files::open(&self.path)?;
        let mut header = vec![0; HEADER.min(length as usize)];
        file.read_exact(&mut header)?;
        self.check_header(&header).map_err(io::Error::other)?;
        let file = &*self.file.insert(file);
        let mut at = HEADER as u64;
        while at < length {
            let damaged = || io::Error::other("the file is cut short or damaged");
            let (name, place) = record(file, at, length).ok_or_else(damaged)?;
            at = place.begin + place.length + CHECKSUM;
            self.records.insert(name, place);
        }
        Ok(())
    }

    fn check_header(&self, bytes: &[u8]) -> Result<(), String> {
        let rest = bytes.strip_prefix(MAGIC).ok_or("not a cache of surfaced")?;
        let (version, rest) = rest.split_first_chunk().ok_or("the file is cut short")?;
        let version = u16::from_le_bytes(*version);
        if version != VERSION {
            return Err(format!("a cache of version {version}, not {VERSION}"));
        }
        let (key, _) = rest.split_first_chunk().ok_or("the file is cut short")?;
        let is_same = u64::from_le_bytes(*key) == self.key;
        is_same.then_some(()).ok_or_else(|| "prepared with other settings".into())
    }

    /// The bytes stored under `name`; `None` if they are damaged or were stored with another stamp.
    pub(crate) fn get(&self, name: &str, stamp: u64) -> Option<Vec<u8>> {
        let place = self.records.get(name).filter(|place| place.stamp == stamp)?;
        // A damaged file may claim that a record is larger than the memory.
        let length = usize::try_from(place.length + CHECKSUM).ok()?;
        let mut bytes = Vec::new();
        bytes.try_reserve_exact(length).ok()?;
        bytes.resize(length, 0);
        read_exact_at(self.file.as_ref()?, &mut bytes, place.begin).ok()?;
        let sum = bytes.split_off(place.length as usize);
        (checksum(&head(name, stamp, place.length), &bytes)[..] == sum).then_some(bytes)
    }

    /// Replaces the file by a new one. `record` returns the record for each index below `count`, if
    /// it has one; a few records are in memory at a time, since together they may be as large as
    /// the library. Writes nothing if there are no records. Returns a remark if writing failed.
    pub(crate) fn replace(
        mut self,
        count: usize,
        record: impl Fn(&Self, usize) -> Option<Record> + Sync,
    ) -> Option<String> {
        self.write(count, record).err().map(|error| {
            format!(
                "{}: {error}; the prepared library is not kept, and will be prepared anew next time",
                self.path.display()
            )
        })
    }

    fn write(
        &mut self,
        count: usize,
        record: impl Fn(&Self, usize) -> Option<Record> + Sync,
    ) -> io::Result<()> {
        let folder = self.path.parent().unwrap_or(Path::new("."));
        let name = self.path.file_name().unwrap_or_default();
        remove_abandoned(folder, &name.to_string_lossy());
        // Each program writes a file of its own, since two programs may write at once.
        let unfinished = tempfile::Builder::new()
            .prefix(&[name, OsStr::new(".")].join(OsStr::new("")))
            .rand_bytes(16)
            .suffix(UNFINISHED)
            .make_in(folder, |path| File::create_new(path))?;
        // A failed lock does no harm: without locks, other programs never remove unfinished files.
        let _ = unfinished.as_file().try_lock();
        let mut file = BufWriter::with_capacity(1 << 20, unfinished.as_file());
        file.write_all(MAGIC)?;
        file.write_all(&VERSION.to_le_bytes())?;
        file.write_all(&self.key.to_le_bytes())?;
        let mut is_empty = true;
        for first in (0..count).step_by(AT_ONCE) {
            let few = (first..count.min(first + AT_ONCE)).into_par_iter();
            for record in few.filter_map(|i| record(self, i)).collect::<Vec<_>>() {
                let head = head(&record.name, record.stamp, record.bytes.len() as u64);
                file.write_all(&head)?;
                file.write_all(&record.bytes)?;
                file.write_all(&checksum(&head, &record.bytes))?;
                is_empty = false;
            }
        }
        file.flush()?;
        drop(file);
        if is_empty {
            return Ok(());
        }
        // The old file is closed first, since some file systems refuse to replace an open file.
        self.file = None;
        persist(unfinished, &self.path)
    }
}

/// Removes unfinished files of the cache `name` if their writers were killed.
fn remove_abandoned(folder: &Path, name: &str) {
    // Errors are ignored throughout: a file that is left behind only takes up space.
    let Ok(items) = fs::read_dir(folder) else { return };
    for path in items.flatten().map(|item| item.path()) {
        let of_cache = |name_of: &str| name_of.starts_with(name) && name_of.ends_with(UNFINISHED);
        if !path.file_name().and_then(|name| name.to_str()).is_some_and(of_cache) {
            continue;
        }
        let Ok((file, _)) = files::open(&path) else { continue };
        let modified = file.metadata().and_then(|about| about.modified());
        let age = modified.ok().and_then(|at| at.elapsed().ok());
        let left = age.is_some_and(|age| age >= ABANDONED);
        if left && file.try_lock().is_ok() {
            let _ = fs::remove_file(&path);
        }
    }
}

/// The name, stamp and length of a record, which precede its bytes in the file.
fn head(name: &str, stamp: u64, length: u64) -> Vec<u8> {
    let mut head = (name.len() as u32).to_le_bytes().to_vec();
    head.extend(name.as_bytes());
    head.extend(stamp.to_le_bytes());
    head.extend(length.to_le_bytes());
    head
}

fn checksum(head: &[u8], bytes: &[u8]) -> [u8; CHECKSUM as usize] {
    let mut sum = crc32fast::Hasher::new();
    sum.update(head);
    sum.update(bytes);
    sum.finalize().to_le_bytes()
}

/// The name and place of the record at byte `at` of a file of `length` bytes; `None` if it is damaged.
fn record(file: &File, at: u64, length: u64) -> Option<(String, Place)> {
    let mut name_length = [0; 4];
    read_exact_at(file, &mut name_length, at).ok()?;
    let name_length = u32::from_le_bytes(name_length);
    if name_length == 0 || name_length > LONGEST_NAME {
        return None;
    }
    let mut rest = vec![0; name_length as usize + 16];
    read_exact_at(file, &mut rest, at + 4).ok()?;
    let (name, numbers) = rest.split_at(name_length as usize);
    let (stamp, count) = numbers.split_at(8);
    let number = |bytes: &[u8]| Some(u64::from_le_bytes(*bytes.first_chunk()?));
    let begin = at + 4 + rest.len() as u64;
    let place = Place { stamp: number(stamp)?, begin, length: number(count)? };
    let end = begin.checked_add(place.length)?.checked_add(CHECKSUM)?;
    Some((String::from_utf8(name.to_vec()).ok()?, place)).filter(|_| end <= length)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    fn records() -> Vec<Record> {
        let record =
            |name: &str, stamp, byte| Record { name: name.into(), stamp, bytes: vec![byte; 100] };
        vec![record("oak · expert · 1", 7, 1), record("beech", 8, 2)]
    }

    fn replace(cache: Cache) -> Option<String> {
        let records = records();
        cache.replace(records.len(), |_, i| Some(records[i].clone()))
    }

    fn written() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let (cache, remark) = Cache::open(folder.path(), "m", 5);
        let path = cache.path.clone();
        assert_eq!((remark, replace(cache)), (None, None));
        (folder, path)
    }

    #[test]
    fn what_was_stored_is_found_under_its_name_and_stamp() {
        let (folder, _) = written();
        let (cache, remark) = Cache::open(folder.path(), "m", 5);
        assert_eq!(remark, None);
        assert_eq!(cache.get("beech", 8), Some(vec![2; 100]));
        assert_eq!(cache.get("beech", 9), None, "files have changed");
        assert_eq!(cache.get("ash", 8), None);
        let (cache, _) = Cache::open(folder.path(), "other", 5);
        assert_eq!(cache.get("beech", 8), None);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing unfinished is left");
    }

    #[test]
    fn another_key_another_version_and_another_file_count_as_empty() {
        let (folder, path) = written();
        let (cache, remark) = Cache::open(folder.path(), "m", 6);
        assert!(cache.get("beech", 8).is_none() && remark.unwrap().contains("other settings"));
        let mut bytes = fs::read(&path).unwrap();
        bytes[14] += 1;
        fs::write(&path, &bytes).unwrap();
        let (cache, remark) = Cache::open(folder.path(), "m", 5);
        assert!(cache.get("beech", 8).is_none() && remark.unwrap().contains("of version 4"));
        fs::write(&path, "something else").unwrap();
        assert!(Cache::open(folder.path(), "m", 5).1.unwrap().contains("not a cache of surfaced"));
    }

    #[test]
    fn damage_anywhere_never_gives_wrong_bytes() {
        let (folder, path) = written();
        let good = fs::read(&path).unwrap();
        for at in 0..good.len() {
            let mut flipped = good.clone();
            flipped[at] ^= 0x41;
            for bytes in [&flipped[..], &good[..at]] {
                fs::write(&path, bytes).unwrap();
                let found = Cache::open(folder.path(), "m", 5).0.get("beech", 8);
                assert!(found.is_none_or(|found| found == [2; 100]), "{at} of {}", bytes.len());
            }
        }
    }

    #[test]
    fn a_record_of_a_terabyte_is_not_read() {
        let (folder, path) = written();
        let mut bytes = fs::read(&path).unwrap();
        let at = HEADER + head("oak · expert · 1", 7, 0).len() - 8;
        bytes[at..at + 8].copy_from_slice(&(1u64 << 40).to_le_bytes());
        fs::write(&path, bytes).unwrap();
        File::options().write(true).open(&path).unwrap().set_len(1 << 41).unwrap();
        let (cache, _) = Cache::open(folder.path(), "m", 5);
        assert_eq!(cache.get("oak · expert · 1", 7), None);
    }

    #[test]
    fn what_is_no_regular_file_neither_hangs_nor_is_read() {
        for is_folder in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join(".m.surfaced-cache");
            let made = if is_folder { fs::create_dir(&path) } else { symlink("/dev/zero", &path) };
            made.unwrap();
            let (cache, remark) = Cache::open(folder.path(), "m", 5);
            assert!(remark.unwrap().contains("not a regular file"));
            assert_eq!(replace(cache).is_none(), !is_folder);
        }
        // Only the beginning of a huge file that is no cache is read.
        let folder = tempfile::tempdir().unwrap();
        let file = File::create(folder.path().join(".m.surfaced-cache")).unwrap();
        file.set_len(1 << 40).unwrap();
        assert!(Cache::open(folder.path(), "m", 5).1.unwrap().contains("not a cache of surfaced"));
    }

    #[test]
    fn nobody_removes_what_another_is_writing_but_what_the_killed_left() {
        let folder = tempfile::tempdir().unwrap();
        let long_ago = std::time::SystemTime::now() - 2 * ABANDONED;
        let [left, locked, fresh] = ["a", "b", "c"].map(|name| {
            let path = folder.path().join(format!(".m.surfaced-cache.{name}{UNFINISHED}"));
            let file = File::create(&path).unwrap();
            file.set_modified(long_ago).unwrap();
            (path, file)
        });
        locked.1.try_lock().unwrap();
        fresh.1.set_modified(std::time::SystemTime::now()).unwrap();
        let (cache, _) = Cache::open(folder.path(), "m", 5);
        assert_eq!(replace(cache), None);
        assert!(!left.0.exists() && locked.0.exists() && fresh.0.exists());
    }
}
