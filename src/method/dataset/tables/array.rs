//! Arrays of samples, as NumPy and MATLAB hold them: trials × channels × samples, or channels × samples of
//! one trial, or the samples of one channel.

use std::io::Read;
use std::iter::once;

use crate::scene::MOST_CHANNELS;
use crate::trial::Series;

/// The largest array of labels, or of trials that lie crosswise (Fortran's order), in bytes.
pub(super) const MOST_WHOLE: u64 = 1 << 28;

pub(super) struct Array {
    pub shape: Vec<usize>,
    pub kind: Kind,
    /// Bytes of an element.
    pub size: usize,
    pub is_big_endian: bool,
    pub is_crosswise: bool,
    /// Whether it holds trials × samples × channels.
    pub samples_first: bool,
    pub content: Box<dyn Read>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Kind {
    Float,
    Signed,
    Unsigned,
    /// Text of UTF-32 units.
    Wide,
    Bytes,
}

/// The trials of a file, which lie in one array or in several.
pub struct Trials {
    pub count: usize,
    pub channels: usize,
    /// How its dimensions are understood by the number of labels.
    pub note: Option<&'static str>,
    pub(super) arrays: Box<dyn Iterator<Item = Result<Array, String>>>,
}

impl Trials {
    /// The trials of an array. If it has as many rows as there are labels, each row is a trial: of one channel if
    /// it has two dimensions, and of samples × channels if these are fewer than the samples.
    pub(super) fn of(mut array: Array, labels: Option<usize>) -> Result<Self, String> {
        let note = match array.shape[..] {
            [rows, _] if rows > 1 && labels == Some(rows) => {
                array.shape.insert(1, 1);
                Some("each row is a trial of one channel, since there are as many labels")
            }
            [trials, samples, channels] if samples > channels && labels == Some(trials) => {
                array.shape.swap(1, 2);
                array.samples_first = true;
                Some("the array holds trials × samples × channels, since there are as many labels")
            }
            _ => None,
        };
        let [count, channels, _] = array.dimensions()?;
        Ok(Self { count, channels, note, arrays: Box::new(once(Ok(array))) })
    }
}

impl Array {
    pub(super) fn is_number(&self) -> bool {
        matches!(self.kind, Kind::Float | Kind::Signed | Kind::Unsigned)
    }

    /// The samples of one trial after the other, channel by channel.
    pub(super) fn trials(
        mut self,
    ) -> Result<impl Iterator<Item = Result<Vec<f32>, String>>, String> {
        let [trials, channels, samples] = self.dimensions()?;
        let (count, is_turned) = (channels * samples, self.samples_first);
        let (rows, columns) = if is_turned { (samples, channels) } else { (channels, samples) };
        let whole = self.is_crosswise.then(|| self.crosswise(trials, rows, columns));
        let whole = whole.transpose()?;
        let turned = move |values: Vec<f32>| match is_turned {
            true => (0..count).map(|at| values[at % samples * channels + at / samples]).collect(),
            false => values,
        };
        let values = move |trial: usize| match &whole {
            Some(whole) => Ok(whole[trial * count..(trial + 1) * count].to_vec()),
            None => self.numbers(count),
        };
        Ok((0..trials).map(values).map(move |values| values.map(&turned)))
    }

    pub(super) fn dimensions(&self) -> Result<[usize; 3], String> {
        let shape = match self.shape[..] {
            _ if !self.is_number() => return Err("its elements are text, not samples".into()),
            [samples] => [1, 1, samples],
            [channels, samples] => [1, channels, samples],
            [trials, channels, samples] => [trials, channels, samples],
            _ => {
                let found = self.shape.len();
                return Err(format!(
                    "it has {found} dimensions; expected trials × channels × samples"
                ));
            }
        };
        let [_, channels, samples] = shape;
        if shape.contains(&0) {
            return Err("it holds no samples".into());
        }
        if channels > MOST_CHANNELS || channels > samples {
            return Err(format!(
                "it has {channels} channels of {samples} samples; expected trials × channels × samples: \
                 turn the array (`X.transpose(0, 2, 1)`, `permute(X, [1 3 2])`; of two dimensions, \
                 `X.T`, `X'`)"
            ));
        }
        let most = Series::MOST_SAMPLES;
        match channels.checked_mul(samples).is_some_and(|count| count <= most) {
            true => Ok(shape),
            false => Err(format!("a trial of it has more than {most} samples; cut it into trials")),
        }
    }

    fn numbers(&mut self, count: usize) -> Result<Vec<f32>, String> {
        let bytes = self.bytes(count)?;
        Ok(bytes.chunks_exact(self.size).map(|element| self.number(element) as f32).collect())
    }

    /// Takes memory for the bytes that are there, not for those that the header claims.
    fn bytes(&mut self, count: usize) -> Result<Vec<u8>, String> {
        let (mut bytes, length) = (Vec::new(), (count * self.size) as u64);
        let read = self.content.by_ref().take(length).read_to_end(&mut bytes);
        match read.map_err(|error| format!("truncated, or damaged: {error}"))? as u64 {
            read if read == length => Ok(bytes),
            read => Err(format!("truncated: of {length} bytes, {read} are there")),
        }
    }

    /// Reads an array in Fortran's order, and puts it into the usual order.
    fn crosswise(&mut self, a: usize, b: usize, c: usize) -> Result<Vec<f32>, String> {
        let count = a.checked_mul(b * c).filter(|count| (*count * self.size) as u64 <= MOST_WHOLE);
        let count = count.ok_or(
            "it is too large for an array whose trials lie crosswise: save it by NumPy in C's order, or by \
             MATLAB as a cell array of trials",
        )?;
        let values = self.numbers(count)?;
        let mut turned = vec![0.0; count];
        for (at, value) in values.into_iter().enumerate() {
            let (first, second, third) = (at % a, at / a % b, at / (a * b));
            turned[(first * b + second) * c + third] = value;
        }
        Ok(turned)
    }

    fn number(&self, element: &[u8]) -> f64 {
        let mut bytes = [0; 8];
        bytes[..element.len()].copy_from_slice(element);
        if self.is_big_endian {
            bytes[..element.len()].reverse();
        }
        let bits = u64::from_le_bytes(bytes);
        match (self.kind, element.len()) {
            (Kind::Float, 8) => f64::from_bits(bits),
            (Kind::Float, 4) => f64::from(f32::from_bits(bits as u32)),
            (Kind::Float, _) => half(bits as u16),
            (Kind::Signed, size) => {
                let unused = 64 - 8 * size as u32;
                ((bits << unused) as i64 >> unused) as f64
            }
            _ => bits as f64,
        }
    }

    /// All elements as text, one for each trial: names, or whole numbers.
    pub(crate) fn labels(mut self) -> Result<Vec<String>, String> {
        let count = match self.shape[..] {
            [count] | [count, 1] | [1, count] => count,
            _ => {
                let shape = &self.shape;
                return Err(format!("labels have the shape {shape:?}; expected one a trial"));
            }
        };
        if count.saturating_mul(self.size) as u64 > MOST_WHOLE {
            return Err("labels are too many".into());
        }
        let bytes = self.bytes(count)?;
        let label = |element: &[u8]| match self.kind {
            Kind::Bytes => String::from_utf8_lossy(element).trim_end_matches('\0').to_string(),
            Kind::Wide => {
                let units = element.as_chunks::<4>().0.iter();
                let unit = |four: &[u8; 4]| match self.is_big_endian {
                    true => u32::from_be_bytes(*four),
                    false => u32::from_le_bytes(*four),
                };
                let chars = units.map(unit).take_while(|unit| *unit != 0);
                chars.map(|unit| char::from_u32(unit).unwrap_or('\u{fffd}')).collect()
            }
            _ => self.number(element).to_string(),
        };
        Ok(bytes.chunks_exact(self.size).map(label).collect())
    }
}

/// A 16-bit float (IEEE 754 binary16).
pub(super) fn half(bits: u16) -> f64 {
    let sign = if bits & 0x8000 == 0 { 1.0 } else { -1.0 };
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 0x3ff));
    match exponent {
        31 if fraction == 0.0 => sign * f64::INFINITY,
        31 => f64::NAN,
        0 => sign * fraction * 2f64.powi(-24),
        _ => sign * (1.0 + fraction / 1024.0) * 2f64.powi(exponent - 15),
    }
}
