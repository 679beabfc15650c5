//! Samples messages: consecutive samples of all channels.

use crate::MAX_CHANNELS;

/// Consecutive samples; their values stay encoded as on the wire (little-endian i16).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Samples<'a> {
    first_index: u64,
    channels: u8,
    bytes: &'a [u8],
}

impl<'a> Samples<'a> {
    /// Samples with the values in `bytes`: little-endian i16, all `channels` of the first sample,
    /// then all channels of the second, and so on.
    ///
    /// # Errors
    /// Unless there are 1 to 16 channels, 1 to 255 whole samples, and indexes within u64.
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
        // The cast loses nothing: there are at most 16 channels.
        let channels = channels as u8;
        Ok(Self { first_index, channels, bytes })
    }

    /// Index of the first sample: the number of ticks of the sampling clock since the start.
    #[must_use]
    pub fn first_index(&self) -> u64 {
        self.first_index
    }

    /// Index that follows the last sample's; the next message has it unless samples were lost.
    #[must_use]
    pub fn next_index(&self) -> u64 {
        // The sum cannot overflow: `new` checked it.
        self.first_index + self.count() as u64
    }

    /// Number of values in one sample.
    #[must_use]
    pub fn channels(&self) -> usize {
        usize::from(self.channels)
    }

    /// Number of samples, at least 1.
    #[must_use]
    pub fn count(&self) -> usize {
        self.bytes.len() / (2 * self.channels())
    }

    /// The values as encoded on the wire: little-endian i16, 2 × channels × count bytes.
    #[must_use]
    pub fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// The decoded values, sample after sample: channels × count values.
    pub fn values(&self) -> impl ExactSizeIterator<Item = i16> + 'a {
        self.bytes.as_chunks().0.iter().map(|pair| i16::from_le_bytes(*pair))
    }

    /// Copies values to the front of `out`, as many as fit, and returns how many were copied.
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
