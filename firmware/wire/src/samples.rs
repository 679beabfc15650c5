//! A run of consecutive samples of all channels.

use crate::MAX_CHANNELS;

/// Consecutive samples, their values kept as they stand on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Samples<'a> {
    first_index: u64,
    channels: u8,
    bytes: &'a [u8],
}

impl<'a> Samples<'a> {
    /// Samples whose values are the little-endian i16 in `bytes`, all `channels` of the first
    /// sample, then of the second, and so on.
    ///
    /// # Errors
    /// Names the rule broken: 1 to 16 channels, 1 to 255 whole samples, an index that does not wrap.
    pub fn new(first_index: u64, channels: usize, bytes: &'a [u8]) -> Result<Self, &'static str> {
        if channels == 0 || channels > MAX_CHANNELS {
            return Err("samples have 1 to 16 channels");
        }
        if !bytes.len().is_multiple_of(2 * channels) {
            return Err("values are not a whole number of samples");
        }
        let count = bytes.len() / (2 * channels);
        if count == 0 || count > usize::from(u8::MAX) {
            return Err("samples come 1 to 255 at a time");
        }
        if first_index.checked_add(count as u64).is_none() {
            return Err("the sample index would wrap");
        }
        // channels <= 16 by the check above.
        let channels = channels as u8;
        Ok(Self { first_index, channels, bytes })
    }

    /// Index of the first sample, counted from the start in ticks of the sampling clock.
    #[must_use]
    pub fn first_index(&self) -> u64 {
        self.first_index
    }

    /// Index that the sample after the last one has if none is missing.
    #[must_use]
    pub fn next_index(&self) -> u64 {
        // Cannot wrap: `new` has refused it.
        self.first_index + self.count() as u64
    }

    /// Values in one sample.
    #[must_use]
    pub fn channels(&self) -> usize {
        usize::from(self.channels)
    }

    /// Number of samples, at least 1.
    #[must_use]
    pub fn count(&self) -> usize {
        self.bytes.len() / (2 * self.channels())
    }

    /// The values as they stand on the wire, little-endian, 2 × channels × count bytes.
    #[must_use]
    pub fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// The values, sample after sample: channels × count of them.
    pub fn values(&self) -> impl ExactSizeIterator<Item = i16> + 'a {
        self.bytes.as_chunks().0.iter().map(|pair| i16::from_le_bytes(*pair))
    }

    /// Copies the values to the front of `out`, as many as fit, and returns how many.
    pub fn copy_values(&self, out: &mut [i16]) -> usize {
        let values = self.values();
        let n = values.len().min(out.len());
        for (slot, value) in out.iter_mut().zip(values) {
            *slot = value;
        }
        n
    }

    pub(crate) fn parse(body: &'a [u8]) -> Result<Self, &'static str> {
        let (index, rest) = body.split_first_chunk::<8>().ok_or("samples without an index")?;
        let (&[channels, count], values) =
            rest.split_first_chunk::<2>().ok_or("samples without a count")?;
        let samples = Self::new(u64::from_le_bytes(*index), usize::from(channels), values)?;
        if samples.count() != usize::from(count) {
            return Err("the count is not that of the values");
        }
        Ok(samples)
    }
}
