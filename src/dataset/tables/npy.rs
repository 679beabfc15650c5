//! Arrays of NumPy: `.npy` files and the arrays of an `.npz`, by NEP 1 of NumPy. An array holds trials ×
//! channels × samples, or channels × samples of one trial, or the samples of one channel.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

use super::gather::Rows;
use super::text::{Lines, shown};
use super::{Form, OnRead, Said, give, name_of, trial_number, zip};
use crate::library::LibraryError;
use crate::library::files;
use crate::printable::counted;
use crate::scene::MOST_CHANNELS;
use crate::trial::{EXPERT, Series, TrialKey, normal};

const MAGIC: &[u8] = b"\x93NUMPY";
/// Longest header that is read, in bytes.
const MOST_HEADER: usize = 1 << 16;
/// The largest array of labels, or of trials that lie crosswise (Fortran's order), in bytes.
const MOST_WHOLE: u64 = 1 << 28;

/// The header of an array, and a reader of its content.
pub(crate) struct Array {
    pub shape: Vec<usize>,
    kind: Kind,
    /// Bytes of an element.
    size: usize,
    is_big_endian: bool,
    is_crosswise: bool,
    content: Box<dyn Read>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Float,
    Signed,
    Unsigned,
    /// Text of UTF-32 units.
    Wide,
    /// Text of bytes.
    Bytes,
}

/// Whether a file holds arrays, by its name.
pub(crate) fn is_array(path: &Path) -> bool {
    let extension = path.extension().map(|extension| extension.to_ascii_lowercase());
    extension.is_some_and(|extension| extension == "npy" || extension == "npz")
}

impl Array {
    /// Opens the array in a file; in an `.npz`, the one called `name`, or the only one of at least two
    /// dimensions.
    ///
    /// # Errors
    /// If the file is damaged, holds another type, or its array is not clear.
    pub(crate) fn open(path: &Path, name: Option<&str>, most: u64) -> Result<Self, LibraryError> {
        let (file, length) = files::open(path).map_err(|error| LibraryError::io(path, error))?;
        Self::of(file, length, name, most).map_err(|problem| LibraryError::file(path, problem))
    }

    fn of(mut file: File, length: u64, name: Option<&str>, most: u64) -> Result<Self, String> {
        let said = |error: std::io::Error| format!("it cannot be read: {error}");
        let mut start = [0; 4];
        file.read_exact(&mut start).map_err(|_| "it is cut short".to_string())?;
        file.rewind().map_err(said)?;
        if !start.starts_with(b"PK") {
            return Self::read(Box::new(BufReader::new(file)), Some(length));
        }
        let members = zip::members(&mut file, length)?;
        let names = || members.iter().map(|member| &*member.name).collect::<Vec<_>>().join(", ");
        let open = |member: &zip::Member| {
            let file = file.try_clone().map_err(said)?;
            Self::read(zip::content(file, member, most)?, None)
        };
        if let Some(name) = name {
            let is = |member: &&zip::Member| member.name.strip_suffix(".npy") == Some(name);
            let member = members.iter().find(is);
            return open(
                member.ok_or_else(|| format!("it has no array `{name}`; it has {}", names()))?,
            );
        }
        let mut found = None;
        for member in members.iter().filter(|member| member.name.ends_with(".npy")) {
            // All members share one file, so only one may be read from at a time.
            if open(member).is_ok_and(|array| array.shape.len() > 1 && array.is_number())
                && found.replace(member).is_some()
            {
                return Err(format!(
                    "it has several arrays ({}); say which by --variable",
                    names()
                ));
            }
        }
        open(found.ok_or_else(|| format!("it has no array of trials; it has {}", names()))?)
    }

    /// Reads a header. `length` is that of the whole file, if it is known.
    pub(crate) fn read(mut from: Box<dyn Read>, length: Option<u64>) -> Result<Self, String> {
        let short = |_| "its header is cut short".to_string();
        let mut start = [0; 8];
        from.read_exact(&mut start).map_err(short)?;
        if !start.starts_with(MAGIC) {
            return Err("it is no array of NumPy (.npy)".into());
        }
        let mut size = [0; 4];
        let digits = if start[6] == 1 { 2 } else { 4 };
        from.read_exact(&mut size[..digits]).map_err(short)?;
        let size = u32::from_le_bytes(size) as usize;
        if size > MOST_HEADER || !(1..=3).contains(&start[6]) {
            return Err("its header is damaged".into());
        }
        let mut header = vec![0; size];
        from.read_exact(&mut header).map_err(short)?;
        let header = String::from_utf8_lossy(&header);
        let value = |key: &str| {
            let at = header.find(&format!("'{key}':"))? + key.len() + 3;
            Some(header[at..].trim_start())
        };
        let damaged = || format!("its header is damaged: {}", header.trim().escape_debug());
        let quoted = value("descr").and_then(|text| text.strip_prefix('\''));
        let Some((descr, _)) = quoted.and_then(|text| text.split_once('\'')) else {
            return Err("its elements are records or objects; save plain numbers".into());
        };
        let (order, kind) = descr.split_at_checked(1).ok_or_else(damaged)?;
        let (kind, size) = kind.split_at_checked(1).ok_or_else(damaged)?;
        // Objects have no size.
        let size: usize = size.parse().unwrap_or(0);
        let (kind, size) = match (kind, size) {
            ("f", 2 | 4 | 8) => (Kind::Float, size),
            ("i", 1 | 2 | 4 | 8) => (Kind::Signed, size),
            ("u", 1 | 2 | 4 | 8) | ("b", 1) => (Kind::Unsigned, size),
            ("U", 1..=1000) => (Kind::Wide, 4 * size),
            ("S", 1..=4000) => (Kind::Bytes, size),
            _ => return Err(format!("its elements are `{descr}`; save float32 or integers")),
        };
        let shape = value("shape").and_then(|text| text.strip_prefix('(')?.split_once(')'));
        let (shape, _) = shape.ok_or_else(damaged)?;
        let shape: Option<Vec<usize>> = shape
            .split(',')
            .map(str::trim)
            .filter(|part| !part.is_empty())
            .map(|part| part.parse().ok())
            .collect();
        let shape = shape.ok_or_else(damaged)?;
        let bytes = shape.iter().try_fold(size as u64, |all, part| all.checked_mul(*part as u64));
        let bytes = bytes.ok_or_else(damaged)?;
        if length.is_some_and(|length| bytes > length) {
            return Err(format!("truncated: {shape:?} elements of {size} bytes are not there"));
        }
        let is_crosswise = value("fortran_order").is_some_and(|text| text.starts_with("True"));
        Ok(Self { shape, kind, size, is_big_endian: order == ">", is_crosswise, content: from })
    }

    /// The number of trials, by the shape; 0 if the shape is none of trials.
    pub(crate) fn trials_count(&self) -> usize {
        self.dimensions().map_or(0, |[trials, ..]| trials)
    }

    /// The number of channels.
    ///
    /// # Errors
    /// If the array has other dimensions than trials have.
    pub(crate) fn channels(&self) -> Result<usize, String> {
        self.dimensions().map(|[_, channels, _]| channels)
    }

    fn is_number(&self) -> bool {
        matches!(self.kind, Kind::Float | Kind::Signed | Kind::Unsigned)
    }

    /// Gives the trials one after the other to `on`: number from 0, number of channels, and samples,
    /// frame by frame.
    ///
    /// # Errors
    /// If the array has other dimensions or is damaged; an error of `on`.
    pub(crate) fn trials(
        mut self,
        on: &mut dyn FnMut(usize, usize, Vec<f32>) -> Result<(), LibraryError>,
        path: &Path,
    ) -> Result<(), LibraryError> {
        let fail = |problem: String| LibraryError::file(path, problem);
        let [trials, channels, samples] = self.dimensions().map_err(fail)?;
        let count = channels * samples;
        let mut whole = match self.is_crosswise {
            true => Some(self.crosswise(trials, channels, samples).map_err(fail)?),
            false => None,
        };
        for trial in 0..trials {
            let values = match &mut whole {
                Some(whole) => whole[trial * count..(trial + 1) * count].to_vec(),
                None => self.numbers(count).map_err(fail)?,
            };
            let mut frames = vec![0.0; count];
            for (at, value) in values.into_iter().enumerate() {
                frames[at % samples * channels + at / samples] = value;
            }
            on(trial, channels, frames)?;
        }
        Ok(())
    }

    fn dimensions(&self) -> Result<[usize; 3], String> {
        let shape = match self.shape[..] {
            _ if !self.is_number() => return Err("its elements are text, not samples".into()),
            [samples] => [1, 1, samples],
            [channels, samples] => [1, channels, samples],
            [trials, channels, samples] => [trials, channels, samples],
            _ => {
                return Err(format!(
                    "it has {} dimensions; expected trials × channels × samples",
                    self.shape.len()
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
                 turn the array by `numpy.transpose`"
            ));
        }
        match channels.checked_mul(samples).is_some_and(|count| count <= Series::MOST_SAMPLES) {
            true => Ok(shape),
            false => Err(format!(
                "a trial of it has more than {} samples; cut it into trials",
                Series::MOST_SAMPLES
            )),
        }
    }

    fn numbers(&mut self, count: usize) -> Result<Vec<f32>, String> {
        let mut bytes = vec![0; count * self.size];
        self.content
            .read_exact(&mut bytes)
            .map_err(|error| format!("truncated, or damaged: {error}"))?;
        Ok(bytes.chunks_exact(self.size).map(|element| self.number(element) as f32).collect())
    }

    /// Reads an array in Fortran's order, and puts it into the usual order.
    fn crosswise(&mut self, a: usize, b: usize, c: usize) -> Result<Vec<f32>, String> {
        let count = a.checked_mul(b * c).filter(|count| (*count * self.size) as u64 <= MOST_WHOLE);
        let count = count.ok_or("it is in Fortran's order and too large; save it in C's order")?;
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
    ///
    /// # Errors
    /// If the array has several dimensions or is damaged.
    pub(crate) fn labels(mut self) -> Result<Vec<String>, String> {
        let count = match self.shape[..] {
            [count] | [count, 1] | [1, count] => count,
            _ => {
                return Err(format!(
                    "labels have the shape {:?}; expected one a trial",
                    self.shape
                ));
            }
        };
        if count.saturating_mul(self.size) as u64 > MOST_WHOLE {
            return Err("labels are too many".into());
        }
        let mut bytes = Vec::new();
        let length = (count * self.size) as u64;
        let read = self.content.by_ref().take(length).read_to_end(&mut bytes);
        if read.map_err(|error| error.to_string())? as u64 != length {
            return Err("labels are cut short".into());
        }
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

/// Reads all trials of an array, like [`super::read`].
pub(super) fn read(path: &Path, form: &Form, on: OnRead<'_>) -> Result<Said, LibraryError> {
    let fail = |problem: String| LibraryError::file(path, problem);
    let array = Array::open(path, form.variable.as_deref(), form.most_unpacked)?;
    if form.rate_hz().is_none() {
        return Err(fail("an array has no column of times; give --rate HZ".into()));
    }
    let labels =
        form.array_labels.as_ref().map(|labels| labels_of(path, labels, form.most_unpacked));
    let labels = labels.transpose()?;
    let count = array.trials_count();
    if let Some(labels) = labels.as_ref().filter(|labels| labels.len() != count) {
        return Err(fail(format!(
            "it has {}, but there are {} labels",
            counted(count, "trial"),
            labels.len()
        )));
    }
    let of_name = form.names.parts(&name_of(path));
    if labels.is_none() && of_name.is_none() {
        let problem = "its name does not fit the pattern";
        return Err(fail(format!("{problem} `{}`; see --names, or give --labels", form.names.0)));
    }
    let [surface, user, number, _] = of_name.unwrap_or_default();
    let session = form.session_of(path).map_err(fail)?;
    let names = form.columns();
    let places =
        names.iter().map(|name| name.parse::<usize>().ok().and_then(|at| at.checked_sub(1)));
    let places: Option<Vec<usize>> = places.collect();
    let places =
        places.ok_or_else(|| fail("the channels of an array are called 1, 2, …".into()))?;
    let (mut said, mut numbers) = (Said::default(), BTreeMap::<String, u32>::new());
    array.trials(
        &mut |at, channels, frames| {
            if let Some(place) = places.iter().find(|place| **place >= channels) {
                return Err(fail(format!(
                    "it has no channel {}, but {channels} channels",
                    place + 1
                )));
            }
            let surface = match &labels {
                Some(labels) => labels[at].clone(),
                None => surface.clone().unwrap_or_default(),
            };
            let next = numbers.entry(surface.clone()).or_default();
            *next += 1;
            let of_file = number.as_deref().and_then(trial_number).filter(|_| count == 1);
            let user = user.clone().unwrap_or_else(|| EXPERT.into());
            let key = TrialKey::new(normal(&surface), normal(&user), of_file.unwrap_or(*next))
                .with_session(session.clone());
            if key.surface.is_empty() {
                return Err(fail(format!("trial {} has no label", at + 1)));
            }
            if let Some(bad) = frames.iter().position(|value| value.is_infinite()) {
                let (frame, channel) = (bad / channels + 1, bad % channels + 1);
                return Err(fail(format!(
                    "{key}, channel {channel}: sample {frame} is not finite"
                )));
            }
            let rows = frames.chunks_exact(channels);
            let values = rows.flat_map(|frame| places.iter().map(|place| frame[*place])).collect();
            on(std::slice::from_ref(&key), None)?;
            give(path, key, Rows { times: Vec::new(), values }, form, None, &mut said, on)
        },
        path,
    )?;
    Ok(said)
}

/// The labels of an array's trials: an array of the same `.npz`, or a file with one label a line or `.npy`.
fn labels_of(path: &Path, labels: &str, most: u64) -> Result<Vec<String>, LibraryError> {
    let file = Path::new(labels);
    let (of, array) = match file.exists() {
        true if is_array(file) => (file, Array::open(file, None, most)?),
        true => {
            let fail = |problem| LibraryError::file(file, problem);
            let (mut lines, mut all) = (Lines::open(file, most)?, Vec::new());
            while let Some((_, line)) = lines.next().map_err(fail)? {
                let label = shown(line.trim_ascii()).trim_matches('"').to_string();
                all.extend(Some(label).filter(|label| !label.is_empty()));
            }
            return Ok(all);
        }
        false => (path, Array::open(path, Some(labels), most)?),
    };
    array.labels().map_err(|problem| LibraryError::file(of, problem))
}

/// A 16-bit float (IEEE 754 binary16).
fn half(bits: u16) -> f64 {
    let sign = if bits & 0x8000 == 0 { 1.0 } else { -1.0 };
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 0x3ff));
    match exponent {
        31 if fraction == 0.0 => sign * f64::INFINITY,
        31 => f64::NAN,
        0 => sign * fraction * 2f64.powi(-24),
        _ => sign * (1.0 + fraction / 1024.0) * 2f64.powi(exponent - 15),
    }
}
