//! A model file: all that is needed to name scans without the library.
//!
//! `surfaced train` writes it; `replay --model` and `run --model` read it. Its form, little-endian:
//!
//! ```text
//! "surfaced model"   version u16   length u64   body: `length` bytes   CRC-32 of all before it u32
//! body:  about, then the model; both in the encoding of postcard 1 (https://postcard.jamesmunns.com/wire-format)
//! about, in this order:
//!   program     string            version of the program that wrote the file
//!   library     string            name of the library
//!   digest      string            of the library's labels and samples, as `made_by` has it in JSON
//!   synthetic   bool
//!   scene       string            sources with rates and bands: the text of a `library.toml`
//!   method      string            method and settings, as JSON
//!   surfaces    [(string, count)] with their numbers of trials, sorted
//!   sources     [string]          that the trials have, sorted
//!   scan_s      option f64        how long a scan must last, in seconds
//!   scan_s_why  option string     the same in words
//!   query_s     option f64        of a plan: replays use only these first seconds of each drag
//!   shape       {string: (rate_hz f64, channels, median_frames)}   of each series
//! ```
//! The model is that of the method `embedding`: scales and trained discriminants, with what is known of
//! left-out trials, from which follow probabilities, unknown surfaces and early answers. It holds the
//! names of trials, but none of their samples.
//!
//! A program opens files of its own [`VERSION`] only. The checksum protects from damage, not from
//! forgery.

use std::borrow::Cow;
use std::fs::File;
use std::io::{self, Read, Seek, Write};
use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::method::Model;
use super::spec::MethodSpec;
use crate::library::files;
use crate::library::shape::LibraryShape;
use crate::scene::{LibraryToml, Scene, SourceId};
use crate::system::persist;

const MAGIC: &[u8; 14] = b"surfaced model";
/// Version of the format. Raise it with each change of what the bytes mean, or of how a scan is turned
/// into features, and replace the fixture in `tests/fixtures`.
const VERSION: u16 = 8;
const HEADER: usize = MAGIC.len() + 2 + 8;
const CHECKSUM: usize = 4;
/// Most bytes of a file, so that a hostile one cannot claim all memory.
const MOST_BYTES: u64 = 1 << 30;
/// Bytes that are in memory at a time until the checksum is known to be right.
const PIECE: usize = 64 << 10;

/// Why a model file cannot be written or opened.
#[derive(Debug, thiserror::Error)]
pub enum ModelFileError {
    #[error("{0}")]
    Io(#[from] io::Error),
    #[error("not a model of surfaced; expected a file that `surfaced train LIB --out FILE` wrote")]
    NotAModel,
    #[error(
        "a model file of version {0}, but this program reads version {VERSION}: use the version of \
         surfaced that wrote it, or make it anew with `surfaced train LIB --out FILE`"
    )]
    Version(u16),
    #[error(
        "damaged: it should have {expected} bytes, but has {found}; copy it again, or make it anew with \
         `surfaced train LIB --out FILE`"
    )]
    Length { expected: u64, found: u64 },
    #[error(
        "a model of {0} bytes, but at most {MOST_BYTES} are possible; use fewer sources (`--sources`)"
    )]
    TooLarge(u64),
    #[error(
        "damaged: its checksum is wrong; copy it again, or make it anew with `surfaced train LIB \
         --out FILE`"
    )]
    Checksum,
    #[error(
        "this program cannot use the model: {0}; make it anew with `surfaced train LIB --out FILE`"
    )]
    Content(String),
    #[error(
        "the method `{0}` is made of the trials at each start, so there is no model file of it; train \
         with --method embedding, or name scans with --library"
    )]
    Method(&'static str),
}

/// All that is needed to name scans without the library.
pub struct ModelFile {
    /// Version of the program that trained the model.
    pub program: String,
    /// Name of the library.
    pub library: String,
    /// Digest of the library's labels and samples.
    pub digest: String,
    pub is_synthetic: bool,
    /// The sources that are compared.
    pub scene: Scene,
    pub method: MethodSpec,
    /// The surfaces, sorted, each with its number of trials.
    pub surfaces: Vec<(String, usize)>,
    /// The sources that the library's trials have, sorted.
    pub sources: Vec<SourceId>,
    /// How long a scan must last, in seconds; `None` if that is not known.
    pub scan_s: Option<f64>,
    /// The scan time in words.
    pub scan_s_why: Option<String>,
    /// Seconds of each drag that a replay uses, if the model follows a plan; `None` for all.
    pub query_s: Option<f64>,
    pub model: Arc<dyn Model>,
}

/// The part of the body before the model.
#[derive(Serialize, Deserialize)]
struct About<'a> {
    program: Cow<'a, str>,
    library: Cow<'a, str>,
    digest: Cow<'a, str>,
    synthetic: bool,
    scene: String,
    method: String,
    surfaces: Cow<'a, [(String, usize)]>,
    sources: Cow<'a, [SourceId]>,
    scan_s: Option<f64>,
    scan_s_why: Option<Cow<'a, str>>,
    query_s: Option<f64>,
    shape: Cow<'a, LibraryShape>,
}

impl ModelFile {
    /// The bytes of the file.
    ///
    /// # Errors
    /// If the method is not `embedding`, or the model is larger than 1 GiB.
    pub fn encode(&self) -> Result<Vec<u8>, ModelFileError> {
        let no_file = || ModelFileError::Method(self.method.name().as_str());
        let embedding = self.model.clone().embedding().ok_or_else(no_file)?;
        let method = serde_json::to_string(&self.method).map_err(content)?;
        let about = About {
            program: (&self.program).into(),
            library: (&self.library).into(),
            digest: (&self.digest).into(),
            synthetic: self.is_synthetic,
            scene: self.scene.to_library_toml(self.is_synthetic),
            method,
            surfaces: (&self.surfaces).into(),
            sources: (&self.sources).into(),
            scan_s: self.scan_s,
            scan_s_why: self.scan_s_why.as_ref().map(Cow::from),
            query_s: self.query_s,
            shape: Cow::Borrowed(&embedding.shape),
        };
        let about = postcard::to_allocvec(&about).map_err(content)?;
        let model = embedding.store().ok_or_else(|| content("it cannot be stored"))?;
        let length = (about.len() + model.len()) as u64;
        let mut bytes = [&MAGIC[..], &VERSION.to_le_bytes(), &length.to_le_bytes()].concat();
        bytes.extend(about);
        bytes.extend(model);
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        check_size(bytes.len() as u64)?;
        Ok(bytes)
    }

    /// Opens the bytes of a file.
    ///
    /// # Errors
    /// If they are not those of a model file of this version, or are damaged.
    pub fn decode(bytes: &[u8]) -> Result<Self, ModelFileError> {
        check_header(&bytes[..bytes.len().min(HEADER)], bytes.len() as u64)?;
        // The header was checked to leave room for the checksum.
        let (summed, sum) = bytes.split_at(bytes.len() - CHECKSUM);
        if crc32fast::hash(summed).to_le_bytes() != *sum {
            return Err(ModelFileError::Checksum);
        }
        let (about, model): (About<'_>, _) =
            postcard::take_from_bytes(&summed[HEADER..]).map_err(content)?;
        let toml = LibraryToml::parse(&about.scene, &Scene::default()).map_err(content)?;
        let method: MethodSpec = serde_json::from_str(&about.method).map_err(content)?;
        let shape = Arc::new(about.shape.into_owned());
        let restored = method.build(&toml.sources).restore(model, &shape);
        Ok(Self {
            program: about.program.into_owned(),
            library: about.library.into_owned(),
            digest: about.digest.into_owned(),
            is_synthetic: about.synthetic,
            scene: toml.sources,
            method,
            surfaces: about.surfaces.into_owned(),
            sources: about.sources.into_owned(),
            scan_s: about.scan_s,
            scan_s_why: about.scan_s_why.map(Cow::into_owned),
            query_s: about.query_s,
            model: restored.ok_or_else(|| content("its parts do not fit each other"))?,
        })
    }

    /// Reads a file. A file that is cut short or altered is refused before it is in memory.
    ///
    /// # Errors
    /// If the file cannot be read, and the errors of [`ModelFile::decode`].
    pub fn read(path: &Path) -> Result<Self, ModelFileError> {
        let (mut file, length) = files::open(path)?;
        let mut header = vec![0; length.min(HEADER as u64) as usize];
        file.read_exact(&mut header)?;
        check_header(&header, length)?;
        file.rewind()?;
        let mut sum = crc32fast::Hasher::new();
        let (mut left, mut piece) = (length - CHECKSUM as u64, vec![0; PIECE]);
        while left > 0 {
            let part = &mut piece[..left.min(PIECE as u64) as usize];
            file.read_exact(part)?;
            sum.update(part);
            left -= part.len() as u64;
        }
        let mut stated = [0; CHECKSUM];
        file.read_exact(&mut stated)?;
        if sum.finalize().to_le_bytes() != stated {
            return Err(ModelFileError::Checksum);
        }
        file.rewind()?;
        let mut bytes = Vec::new();
        // At most `MOST_BYTES`, which the header was checked for.
        bytes.try_reserve_exact(length as usize).map_err(io::Error::from)?;
        // The length holds even if the file grows while it is read.
        file.take(length).read_to_end(&mut bytes)?;
        Self::decode(&bytes)
    }

    /// Writes the file, and replaces one of that name at once. Returns its length in bytes.
    ///
    /// # Errors
    /// If the file cannot be written, and the errors of [`ModelFile::encode`].
    pub fn write(&self, path: &Path) -> Result<u64, ModelFileError> {
        let bytes = self.encode()?;
        // A file that could not be opened again must not replace one that can.
        Self::decode(&bytes)?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        let unfinished = tempfile::Builder::new()
            .prefix(".surfaced-model.")
            .make_in(folder.unwrap_or(Path::new(".")), |path| File::create_new(path))?;
        unfinished.as_file().write_all(&bytes)?;
        unfinished.as_file().sync_all()?;
        persist(unfinished, path)?;
        Ok(bytes.len() as u64)
    }
}

fn content(why: impl ToString) -> ModelFileError {
    ModelFileError::Content(why.to_string())
}

fn check_size(bytes: u64) -> Result<(), ModelFileError> {
    if bytes > MOST_BYTES { Err(ModelFileError::TooLarge(bytes)) } else { Ok(()) }
}

/// Checks the beginning of a file of `found` bytes: at most `HEADER` bytes, and fewer only if the file
/// has no more.
fn check_header(header: &[u8], found: u64) -> Result<(), ModelFileError> {
    let shortest = (HEADER + CHECKSUM) as u64;
    let short = || ModelFileError::Length { expected: shortest, found };
    let Some(rest) = header.strip_prefix(MAGIC) else {
        let is_begun = !header.is_empty() && MAGIC.starts_with(header);
        return Err(if is_begun { short() } else { ModelFileError::NotAModel });
    };
    let (version, rest) = rest.split_first_chunk().ok_or_else(short)?;
    let version = u16::from_le_bytes(*version);
    if version != VERSION {
        return Err(ModelFileError::Version(version));
    }
    let length = rest.first_chunk().ok_or_else(short)?;
    let expected = u64::from_le_bytes(*length).saturating_add(shortest);
    if expected != found {
        return Err(ModelFileError::Length { expected, found });
    }
    check_size(found)
}
