//! A prepared trial of `reference` as bytes, for the cache beside a library.
//!
//! Little-endian. A trial: number of sources; of each its name, its rate and frames (a rate of 0
//! stands for an image), number of sets; of each set: channels, samples, width of a value in bytes
//! (4 or 8), σ, coarseness, mean and centre by channel, whether it is clustered and whether there
//! is a table (1 or 0), the table, then the values. Counts are u32, other numbers f64. Errors: anything that does not fit
//! gives no trial; the cache's checksum guards the rest.

use super::prepared_trial::{PreparedTrial, StoredSource};
use super::sample_set::{SampleSet, Values};
use crate::kernel::{NODES, SelfMean};
use crate::library::Entry;
use crate::scene::SourceId;

/// A trial as bytes; `None` where positions are drawn for each pair, since then it is as large as
/// the recording.
pub fn encode(trial: &PreparedTrial) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    let (mut sources, mut sampled) = (0u32, true);
    put_count(&mut out, 0);
    trial.each_source(|id, shape, sets| {
        sources += 1;
        sampled &= !sets.is_empty();
        put_count(&mut out, id.as_str().len());
        out.extend(id.as_str().as_bytes());
        let (rate_hz, frames) = shape.unwrap_or((0.0, 0));
        put(&mut out, &[rate_hz, frames as f64]);
        put_count(&mut out, sets.len());
        sets.iter().for_each(|set| encode_set(&mut out, set));
    });
    out[..4].copy_from_slice(&sources.to_le_bytes());
    sampled.then_some(out)
}

fn encode_set(out: &mut Vec<u8>, set: &SampleSet) {
    put_count(out, set.dims());
    put_count(out, set.n());
    put_count(out, if matches!(set.values, Values::Single(_)) { 4 } else { 8 });
    put(out, &[set.sigma, set.coarseness]);
    put(out, &set.mean);
    put(out, &set.centre);
    put_count(out, usize::from(set.clustered));
    put_count(out, usize::from(set.table.is_some()));
    if let Some((middle, values)) = set.table.as_ref().map(SelfMean::parts) {
        put(out, &[middle]);
        put(out, values);
    }
    match &set.values {
        Values::Single(values) => out.extend(values.iter().flat_map(|x| x.to_le_bytes())),
        Values::Double(values) => put(out, values),
    }
}

fn put_count(out: &mut Vec<u8>, count: usize) {
    // Samples, channels and names are counted in hundreds.
    out.extend((count as u32).to_le_bytes());
}

fn put(out: &mut Vec<u8>, numbers: &[f64]) {
    out.extend(numbers.iter().flat_map(|x| x.to_le_bytes()));
}

/// A trial from bytes, if they are those of one.
pub fn decode(entry: &Entry, bytes: &[u8]) -> Option<PreparedTrial> {
    let mut from = ByteReader(bytes);
    let mut sources: Vec<StoredSource> = Vec::new();
    for _ in 0..from.count()? {
        let length = from.count()?;
        let name = std::str::from_utf8(from.bytes(length)?).ok()?;
        let [rate_hz, frames] = from.numbers()?;
        let shape = (rate_hz != 0.0).then_some((rate_hz, frames as usize));
        let sets = (0..from.count()?).map(|_| decode_set(&mut from)).collect::<Option<_>>()?;
        sources.push((SourceId::new(name).ok()?, shape, sets));
    }
    from.0.is_empty().then(|| PreparedTrial::from_parts(entry, sources))
}

fn decode_set(from: &mut ByteReader<'_>) -> Option<SampleSet> {
    let (dims, n, width) = (from.count()?, from.count()?, from.count()?);
    let [sigma, coarseness] = from.numbers()?;
    let (mean, centre) = (from.list(dims)?, from.list(dims)?);
    let clustered = from.count()? != 0;
    let table = match from.count()? {
        0 => None,
        _ => {
            let [middle] = from.numbers()?;
            Some(SelfMean::from_parts(middle, from.numbers::<NODES>()?))
        }
    };
    let count = n.checked_mul(dims).filter(|&count| count > 0)?;
    let values = match width {
        4 => {
            let bytes = from.bytes(count.checked_mul(4)?)?;
            Values::Single(bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
        }
        8 => Values::Double(from.list(count)?.into()),
        _ => return None,
    };
    Some(SampleSet::from_parts(values, mean, centre, sigma, coarseness, clustered, table))
}

/// What is left to read.
struct ByteReader<'a>(&'a [u8]);

impl<'a> ByteReader<'a> {
    fn bytes(&mut self, count: usize) -> Option<&'a [u8]> {
        let (head, tail) = self.0.split_at_checked(count)?;
        self.0 = tail;
        Some(head)
    }

    fn count(&mut self) -> Option<usize> {
        let bytes = self.bytes(4)?.try_into().ok()?;
        Some(u32::from_le_bytes(bytes) as usize)
    }

    fn list(&mut self, count: usize) -> Option<Vec<f64>> {
        let bytes = self.bytes(count.checked_mul(8)?)?;
        Some(bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect())
    }

    fn numbers<const N: usize>(&mut self) -> Option<[f64; N]> {
        self.list(N)?.try_into().ok()
    }
}
