//! The spectrum that the page shows: the newest moment of each stream, in bands that grow with
//! frequency.

use serde::Serialize;

use super::trace::{RECENT, TracedStream, Tracer};
use crate::history::{Bands, bands};
use crate::scene::SourceId;

/// The spectra of all streams.
#[derive(Debug, Serialize)]
pub struct SpectrumEvent {
    /// A stream each.
    pub streams: Vec<StreamBands>,
}

/// The spectrum of one stream.
#[derive(Debug, Serialize)]
pub struct StreamBands {
    /// The stream.
    pub source: SourceId,
    /// Its spectrum.
    #[serde(flatten)]
    pub bands: Bands,
}

/// The spectra of the newest frames, of every stream that has enough of them.
pub fn spectra(tracer: &Tracer) -> SpectrumEvent {
    let of = |(source, stream): (&SourceId, &TracedStream)| {
        let TracedStream { rate_hz, channels, recent, .. } = stream;
        let full = recent.len() >= RECENT * channels;
        let samples: Vec<f32> = recent.iter().copied().collect();
        let bands = full.then(|| bands(&samples, *channels, *rate_hz, RECENT))??;
        Some(StreamBands { source: source.clone(), bands })
    };
    SpectrumEvent { streams: tracer.streams().filter_map(of).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::{Fresh, Trace};

    #[test]
    fn a_stream_has_a_spectrum_once_it_has_enough_frames() {
        for (frames, spectra_of) in [(RECENT - 1, 0), (RECENT, 1)] {
            let mut tracer = Tracer::default();
            let source = SourceId::new("ac").unwrap();
            let samples = vec![0.0; frames];
            let fresh = Fresh { source, rate_hz: 10_000.0, channels: 1, start: 0, samples };
            tracer.add(&Trace { fresh: vec![fresh], images: Vec::new() });
            assert_eq!(spectra(&tracer).streams.len(), spectra_of);
        }
    }
}
