//! Reads sounds in lossy forms: mp3, AAC-LC in m4a, and Vorbis in Ogg.
//!
//! The decoders pass over what is damaged or missing, so what can be checked is checked here: that
//! frames of mp3 follow one another without a gap and are as many as the header counts, the tables of
//! m4a, the checksums and numbers of Ogg's pages. The delay of an encoder is cut off where the file
//! tells it: in LAME's header, in an edit list or iTunes's note, in Ogg's positions. Elsewhere it stays.

use std::io::Cursor;
use std::path::Path;

use memchr::memmem;
use symphonia_bundle_mp3::{MpaDecoder, MpaReader};
use symphonia_codec_aac::AacDecoder;
use symphonia_codec_vorbis::VorbisDecoder;
use symphonia_core::checksum::Crc32;
use symphonia_core::codecs::CodecParameters;
use symphonia_core::codecs::audio::well_known::profiles::{
    CODEC_PROFILE_AAC_HE, CODEC_PROFILE_AAC_HE_V2, CODEC_PROFILE_AAC_LC,
};
use symphonia_core::codecs::audio::well_known::{
    CODEC_ID_AAC, CODEC_ID_ALAC, CODEC_ID_MP3, CODEC_ID_OPUS, CODEC_ID_VORBIS,
};
use symphonia_core::codecs::audio::{AudioCodecParameters, AudioDecoder, AudioDecoderOptions};
use symphonia_core::errors::Error;
use symphonia_core::formats::{FormatReader, Track};
use symphonia_core::io::{MediaSourceStream, Monitor};
use symphonia_core::packet::Packet;
use symphonia_format_isomp4::IsoMp4Reader;
use symphonia_format_ogg::OggReader;

use super::files::{self, check_length};
use super::{LibraryError, Outline};
use crate::trial::Series;

/// Takes a file apart without decoding it, which checks all but the content of its frames.
pub(super) fn probe(path: &Path) -> Result<Outline, LibraryError> {
    open(path).map(|sound| sound.header)
}

/// Reads a whole file; the samples are interleaved.
pub(super) fn read(path: &Path) -> Result<(Outline, Vec<f32>), LibraryError> {
    let sound = open(path)?;
    let samples = sound.decode().map_err(|why| why.at(path))?;
    Ok((sound.header, samples))
}

/// Why a file is not read.
enum Why {
    Damaged(String),
    /// A coding, by its name.
    Unknown(&'static str),
}

impl Why {
    fn at(self, path: &Path) -> LibraryError {
        match self {
            Self::Damaged(why) => LibraryError::damaged(path, "sound", &why),
            Self::Unknown(name) => {
                LibraryError::file(path, format!("{name} is not read; convert it to WAV or FLAC"))
            }
        }
    }
}

impl From<Error> for Why {
    fn from(error: Error) -> Self {
        Self::Damaged(error.to_string())
    }
}

fn no<T>(why: impl Into<String>) -> Result<T, Why> {
    Err(Why::Damaged(why.into()))
}

/// A file in its parts.
struct Sound {
    codec: AudioCodecParameters,
    packets: Vec<Packet>,
    /// Decoded frames before the sound begins.
    skip: usize,
    header: Outline,
}

fn open(path: &Path) -> Result<Sound, LibraryError> {
    let bytes = files::read_bytes(path, files::MOST_TEXT)?;
    let sound = match &*files::extension(path) {
        "mp3" => mp3(bytes),
        "m4a" => m4a(bytes),
        _ => ogg(bytes),
    };
    let sound = sound.map_err(|why| why.at(path))?;
    check_length(sound.header).map_err(LibraryError::at(path))?;
    Ok(sound)
}

impl Sound {
    fn new(
        codec: AudioCodecParameters,
        packets: Vec<Packet>,
        skip: usize,
        frames: usize,
    ) -> Result<Self, Why> {
        // A decoder's own header is more reliable than the file around it.
        let decoder = decoder(&codec)?;
        let (Some(rate), Some(channels)) =
            (decoder.codec_params().sample_rate, &decoder.codec_params().channels)
        else {
            return no("its header says neither rate nor channels");
        };
        let header = Outline { rate_hz: f64::from(rate), channels: channels.count(), frames };
        if frames == 0 {
            return no("it holds no sound");
        }
        Ok(Self { codec, packets, skip, header })
    }

    fn decode(&self) -> Result<Vec<f32>, Why> {
        let Outline { rate_hz, channels, frames } = self.header;
        let mut decoder = decoder(&self.codec)?;
        let (mut samples, mut block) = (Vec::new(), Vec::<f32>::new());
        for packet in &self.packets {
            let decoded = decoder.decode(packet)?;
            let (rate, count) = (decoded.spec().rate(), decoded.spec().channels().count());
            if (f64::from(rate), count) != (rate_hz, channels) {
                return no("its rate or its channels change");
            }
            decoded.copy_to_vec_interleaved(&mut block);
            samples.extend_from_slice(&block);
        }
        if samples.len() < (self.skip + frames) * channels {
            return no("truncated: it ends before what its header promises");
        }
        samples.truncate((self.skip + frames) * channels);
        samples.drain(..self.skip * channels);
        Ok(samples)
    }
}

fn decoder(codec: &AudioCodecParameters) -> Result<Box<dyn AudioDecoder>, Error> {
    // Of Vorbis alone, the packets tell what to cut off.
    let options = AudioDecoderOptions::default().gapless(codec.codec == CODEC_ID_VORBIS);
    Ok(match codec.codec {
        CODEC_ID_AAC => Box::new(AacDecoder::try_new(codec, &options)?),
        CODEC_ID_VORBIS => Box::new(VorbisDecoder::try_new(codec, &options)?),
        _ => Box::new(MpaDecoder::try_new(codec, &options)?),
    })
}

fn stream(bytes: Vec<u8>) -> MediaSourceStream<'static> {
    MediaSourceStream::new(Box::new(Cursor::new(bytes)), Default::default())
}

fn codec(track: &Track) -> Option<&AudioCodecParameters> {
    track.codec_params.as_ref().and_then(CodecParameters::audio)
}

fn packets(reader: &mut dyn FormatReader, track: u32) -> Result<Vec<Packet>, Why> {
    // The shortest packet of Vorbis gives 32 frames; a table of m4a may claim packets without end.
    const MOST: usize = Series::MOST_SAMPLES / 32;
    let mut packets = Vec::new();
    for _ in 0..MOST {
        match reader.next_packet()? {
            Some(packet) if packet.track_id == track => packets.push(packet),
            Some(_) => {}
            None => return Ok(packets),
        }
    }
    no("it holds more than a trial may")
}

fn mp3(mut bytes: Vec<u8>) -> Result<Sound, Why> {
    cut_tags(&mut bytes);
    let mut reader = MpaReader::try_new(stream(bytes.clone()), Default::default())?;
    let packets = packets(&mut reader, 0)?;
    let track = &reader.tracks()[0];
    let Some(codec) = codec(track).filter(|codec| codec.codec == CODEC_ID_MP3) else {
        return Err(Why::Unknown("MPEG audio other than mp3"));
    };
    let start = gapless(&bytes, &packets)?;
    let frame = if codec.sample_rate >= Some(32_000) { 1152 } else { 576 };
    let counted = packets.len() * frame;
    let (delay, padding) = (track.delay.unwrap_or(0), track.padding.unwrap_or(0));
    let (delay, cut) = (delay as usize, (delay + padding) as usize);
    // Without a header before the first frame, the number of frames is but a guess.
    let promised = track.num_frames.filter(|_| start > 0).map_or(0, |frames| frames as usize + cut);
    // Headers other than LAME's may count themselves.
    if counted + if delay > 0 { 0 } else { frame } < promised {
        return no(format!("truncated: it holds {counted} of {promised} frames"));
    }
    Sound::new(codec.clone(), packets, delay, counted.saturating_sub(cut))
}

/// Cuts off what players keep before and after the frames of mp3.
fn cut_tags(bytes: &mut Vec<u8>) {
    let mut start = 0;
    while let Some([b'I', b'D', b'3', _, _, flags, a, b, c, d, ..]) = bytes.get(start..) {
        let length = [a, b, c, d].iter().fold(0, |sum, &&byte| sum << 7 | usize::from(byte & 127));
        let footer = if flags & 16 != 0 { 10 } else { 0 };
        start += 10 + length + footer;
    }
    bytes.drain(..start.min(bytes.len()));
    if bytes.len() >= 128 && bytes[bytes.len() - 128..].starts_with(b"TAG") {
        bytes.truncate(bytes.len() - 128);
    }
    for tag in [&b"APETAGEX"[..], b"LYRICSBEGIN"] {
        bytes.truncate(memmem::find(bytes, tag).unwrap_or(bytes.len()));
    }
}

/// Checks that frames follow one another up to the end, and returns where the first of them begins:
/// after a header that takes the place of a frame, or at 0.
fn gapless(bytes: &[u8], packets: &[Packet]) -> Result<usize, Why> {
    let first = packets.first().and_then(|packet| memmem::find(bytes, &packet.data));
    let Some(start) = first else { return no("it holds no sound") };
    let headed =
        [b"Xing", b"Info", b"VBRI"].iter().any(|id| memmem::find(&bytes[..start], *id).is_some());
    if start > 0 && !headed {
        return no("it does not begin with a frame of mp3");
    }
    let mut at = start;
    for packet in packets {
        if !bytes[at..].starts_with(&packet.data) {
            return no(format!("no frame where one should begin, at byte {at} of its sound"));
        }
        at += packet.data.len();
    }
    // Some recorders fill up their last block.
    match bytes[at..].iter().all(|&byte| byte == 0) {
        true => Ok(start),
        false => no("truncated: its last frame is not whole"),
    }
}

/// Frames of a packet of AAC-LC.
const AAC: usize = 1024;

fn m4a(bytes: Vec<u8>) -> Result<Sound, Why> {
    let moov = boxes(&bytes, b"moov").first().map(|moov| moov.to_vec()).unwrap_or_default();
    if !boxes(&moov, b"mvex").is_empty() {
        // Nothing says where it ends.
        return Err(Why::Unknown("MP4 in fragments"));
    }
    let mut reader = IsoMp4Reader::try_new(stream(bytes), Default::default())?;
    let of_sound = |track: &&Track| codec(track).is_some();
    let Some((index, track)) =
        reader.tracks().iter().enumerate().find(|(_, track)| of_sound(track))
    else {
        return no("it holds no sound");
    };
    let (track, codec) = (track.clone(), codec(track).expect("a sound").clone());
    check_lc(&codec)?;
    let packets = packets(&mut reader, track.id)?;
    let asked = &packets[..packets.len().min(64)];
    if 2 * asked.iter().filter(|packet| ends_with_sbr(&packet.data)).count() > asked.len() {
        return Err(Why::Unknown("HE-AAC"));
    }
    let counted = packets.len() * AAC;
    let trak = boxes(&moov, b"trak").get(index).copied().unwrap_or_default();
    let whole = Sound::new(codec, packets, 0, counted)?;
    let (skip, frames) = edited(&moov, trak, &track, &whole.header)?;
    match frames {
        0 => no("it holds no sound"),
        frames => Ok(Sound { skip, header: Outline { frames, ..whole.header }, ..whole }),
    }
}

/// Refuses all but AAC-LC, by its name.
fn check_lc(codec: &AudioCodecParameters) -> Result<(), Why> {
    // An extension after the configuration of AAC-LC that says: with spectral band replication.
    let extended =
        |bytes: &[u8]| bytes.windows(3).any(|at| at[..2] == [0x56, 0xE5] && at[2] >= 0x80);
    let name = match (codec.codec, codec.profile) {
        (CODEC_ID_OPUS, _) => "Opus",
        (CODEC_ID_ALAC, _) => "Apple Lossless",
        (CODEC_ID_AAC, Some(CODEC_PROFILE_AAC_HE | CODEC_PROFILE_AAC_HE_V2)) => "HE-AAC",
        (CODEC_ID_AAC, _) if codec.extra_data.as_deref().is_some_and(extended) => "HE-AAC",
        (CODEC_ID_AAC, Some(CODEC_PROFILE_AAC_LC)) => return Ok(()),
        (CODEC_ID_AAC, _) => "AAC other than AAC-LC",
        _ => "this coding in m4a",
    };
    Err(Why::Unknown(name))
}

/// Whether a frame of AAC ends with fill elements whose first holds the upper band of HE-AAC, which the
/// decoder leaves out. Looks from every bit for elements that end where the frame does: by chance, one
/// frame of AAC-LC in a hundred seems to hold them.
fn ends_with_sbr(frame: &[u8]) -> bool {
    // Of two channels, whole; the search takes the longer the more there is.
    const MOST: usize = 2 * 6144 / 8;
    frame.len() <= MOST
        && (0..8 * frame.len()).any(|at| {
            let Some((content, end)) = fill(frame, at) else { return false };
            end > content
                && matches!(bits(frame, content, 4), Some(13 | 14))
                && fills_up(frame, end)
        })
}

/// Whether nothing but fill elements lies between a bit and the end of a frame.
fn fills_up(frame: &[u8], mut at: usize) -> bool {
    const END: usize = 7;
    while let Some((_, end)) = fill(frame, at) {
        at = end;
    }
    bits(frame, at, 3) == Some(END) && 8 * frame.len() < at + 11
}

/// Begin and end of the content of the fill element at a bit; `None` if there is no such element.
fn fill(frame: &[u8], at: usize) -> Option<(usize, usize)> {
    const FILL: usize = 6;
    bits(frame, at, 3).filter(|&id| id == FILL)?;
    let (size, content) = match bits(frame, at + 3, 4)? {
        15 => (14 + bits(frame, at + 7, 8)?, at + 15),
        size => (size, at + 7),
    };
    Some((content, content + 8 * size))
}

/// The number in some bits, the first of them the highest.
fn bits(bytes: &[u8], at: usize, count: usize) -> Option<usize> {
    (at..at + count)
        .try_fold(0, |sum, at| Some(sum << 1 | usize::from(bytes.get(at / 8)? >> (7 - at % 8) & 1)))
}

/// The content of each box called `name` that lies directly in `bytes`.
fn boxes<'a>(mut bytes: &'a [u8], name: &[u8; 4]) -> Vec<&'a [u8]> {
    let mut found = Vec::new();
    while bytes.len() >= 8 {
        let (size, head) = match number(bytes, 0, 4) {
            0 => (bytes.len() as u64, 8),
            1 => (number(bytes, 8, 8), 16),
            size => (size, 8),
        };
        let size = usize::try_from(size).unwrap_or(usize::MAX);
        let Some(body) = bytes.get(head..size) else { break };
        if bytes[4..8] == *name {
            found.push(body);
        }
        bytes = &bytes[size..];
    }
    found
}

/// A big-endian number; 0 where there is none.
fn number(bytes: &[u8], at: usize, size: usize) -> u64 {
    let digits = bytes.get(at..at + size).unwrap_or_default();
    digits.iter().fold(0, |sum, &byte| sum << 8 | u64::from(byte))
}

/// The first frame of the sound, and the number of its frames.
fn edited(moov: &[u8], trak: &[u8], track: &Track, whole: &Outline) -> Result<(usize, usize), Why> {
    let frames = |time: u64, scale: u64| {
        (time as f64 * whole.rate_hz / scale.max(1) as f64).round() as usize
    };
    let scale = track.time_base.map_or(0, |base| u64::from(base.denom.get()));
    // The last packet may be cut. A table that differs by more tells when packets came, not how long.
    let told = track.duration.map_or(0, |told| frames(told.get(), scale));
    let end = if told <= whole.frames && whole.frames - told < AAC { told } else { whole.frames };
    let mvhd = boxes(moov, b"mvhd").first().copied().unwrap_or_default();
    let movie = if mvhd.first() == Some(&1) { number(mvhd, 20, 4) } else { number(mvhd, 12, 4) };
    let (skip, length) = match edit(trak)? {
        Some([length, start]) if start > 0 || length > 0 => {
            (frames(start, scale), frames(length, movie))
        }
        _ => (0, 0),
    };
    let (skip, length) =
        if skip == 0 { itunes(moov).unwrap_or((0, length)) } else { (skip, length) };
    let left = end.saturating_sub(skip);
    // A film's clock may be coarse, such as one of milliseconds.
    let shorter = length > 0 && length + frames(1, movie) < left;
    Ok((skip, if shorter { length } else { left }))
}

/// The length (on the film's clock) and the begin (on the track's) that an edit list gives.
fn edit(trak: &[u8]) -> Result<Option<[u64; 2]>, Why> {
    let Some(edts) = boxes(trak, b"edts").first().copied() else { return Ok(None) };
    let Some(list) = boxes(edts, b"elst").first().copied() else { return Ok(None) };
    let size = if list.first() == Some(&1) { 8 } else { 4 };
    let entries = list.get(8..).unwrap_or_default().chunks_exact(2 * size + 4);
    let entries = entries.map(|entry| [0, size].map(|at| number(entry, at, size)));
    // A begin of −1 stands for a pause before the sound.
    let entries: Vec<_> = entries.filter(|[_, start]| start >> (8 * size - 1) == 0).collect();
    match entries[..] {
        [] => Ok(None),
        [entry] => Ok(Some(entry)),
        _ => Err(Why::Unknown("m4a that is cut from several parts")),
    }
}

/// The delay and the length in frames that Apple's encoders note.
fn itunes(moov: &[u8]) -> Option<(usize, usize)> {
    let note = &moov[memmem::find(moov, b"iTunSMPB")?..];
    let text = &note[memmem::find(note, b" 00000000 ")?..];
    let text = std::str::from_utf8(text.get(..44)?).ok()?;
    let numbers = text.split_ascii_whitespace().map(|word| usize::from_str_radix(word, 16));
    let numbers = numbers.collect::<Result<Vec<_>, _>>().ok()?;
    let [_, delay, _, length] = numbers[..] else { return None };
    Some((delay, length))
}

fn ogg(bytes: Vec<u8>) -> Result<Sound, Why> {
    let first = bytes.get(28..).unwrap_or_default();
    for (mark, name) in
        [(&b"OpusHead"[..], "Opus"), (b"\x7fFLAC", "FLAC in Ogg"), (b"Speex   ", "Speex")]
    {
        if first.starts_with(mark) {
            return Err(Why::Unknown(name));
        }
    }
    if !first.starts_with(b"\x01vorbis") {
        return no("it does not begin as Vorbis in Ogg does");
    }
    check_pages(&bytes)?;
    let mut reader = OggReader::try_new(stream(bytes), Default::default())?;
    let Some(track) = reader.tracks().first().cloned() else { return no("it holds no sound") };
    let Some(codec) = codec(&track).cloned() else { return no("it holds no sound") };
    let packets = packets(&mut reader, track.id)?;
    let frames = packets.iter().map(|packet| packet.dur.get() as usize).sum();
    Sound::new(codec, packets, 0, frames)
}

/// Checks that pages of one stream follow one another, each whole, up to one that says it is the last.
fn check_pages(bytes: &[u8]) -> Result<(), Why> {
    let (mut rest, mut last) = (bytes, false);
    for page in 0_u32.. {
        if rest.is_empty() {
            break;
        }
        let Some(size) = page_size(rest).filter(|&size| size <= rest.len()) else {
            return no(format!("truncated or damaged at its page {page}"));
        };
        // Flags, position, stream, number and checksum.
        if rest[14..18] != bytes[14..18] || last {
            return Err(Why::Unknown("Ogg of several streams"));
        }
        if rest[18..22] != page.to_le_bytes() || rest[22..26] != checksum(&rest[..size]) {
            return no(format!("damaged at its page {page}"));
        }
        last = rest[5] & 4 != 0;
        rest = &rest[size..];
    }
    if last { Ok(()) } else { no("truncated: its last page is missing") }
}

fn page_size(bytes: &[u8]) -> Option<usize> {
    let lengths = bytes.get(27..27 + usize::from(*bytes.get(26)?))?;
    let content: usize = lengths.iter().map(|&length| usize::from(length)).sum();
    bytes.starts_with(b"OggS").then_some(27 + lengths.len() + content)
}

/// The checksum of a page, which counts its own place as zeros.
fn checksum(page: &[u8]) -> [u8; 4] {
    let mut sum = Crc32::new(0);
    [&page[..22], &[0; 4], &page[26..]].into_iter().for_each(|part| sum.process_buf_bytes(part));
    sum.crc().to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(name: &[u8; 4], content: &[u8]) -> Vec<u8> {
        [&(content.len() as u32 + 8).to_be_bytes(), &name[..], content].concat()
    }

    #[test]
    fn what_apple_s_encoders_note_is_found() {
        let note = b"iTunSMPB\0\0\0\x54data\0\0\0\x01\0\0\0\0 00000000 00000840 000001CA 00000000003F31F6 0";
        assert_eq!(itunes(note), Some((2112, 0x3F31F6)));
        assert_eq!(itunes(&note[..60]), None);
        assert_eq!(itunes(b"iTunes"), None);
    }

    #[test]
    fn an_edit_list_gives_one_part_after_pauses() {
        let entry = |length: u32, start: i32| {
            [&length.to_be_bytes()[..], &start.to_be_bytes(), &[0, 1, 0, 0]].concat()
        };
        let edit = |entries: &[Vec<u8>]| {
            let list = [&[0; 8][..], &entries.concat()].concat();
            edit(&part(b"edts", &part(b"elst", &list))).ok().flatten()
        };
        assert_eq!(edit(&[entry(20, -1), entry(500, 1024)]), Some([500, 1024]));
        assert_eq!(edit(&[entry(500, 1024), entry(500, 9000)]), None);
        assert!(super::edit(&part(b"mdia", &[])).is_ok_and(|edit| edit.is_none()));
    }

    #[test]
    fn boxes_that_claim_too_much_are_left_out() {
        let long = [&1u32.to_be_bytes()[..], b"mdat", &20u64.to_be_bytes(), &[7; 4]].concat();
        let bytes = [long, part(b"moov", &[1]), part(b"free", &[])].concat();
        assert_eq!(boxes(&bytes, b"mdat"), [[7; 4]]);
        assert_eq!(boxes(&bytes, b"moov"), [[1]]);
        for claim in [2u32, 9, u32::MAX] {
            let bytes = [&claim.to_be_bytes()[..], b"moov"].concat();
            assert!(boxes(&bytes, b"moov").is_empty());
        }
    }
}
