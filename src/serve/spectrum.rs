//! The spectrum that the page shows: the newest moment of each stream, in bands that grow with
//! frequency.

use serde::Serialize;

use super::trace::{RECENT, Stream, Tracer};
use crate::recognise::amplitude_spectrum;
use crate::scene::SourceId;

/// Bands of a spectrum.
const BANDS: usize = 96;
/// What silence is shown as, in dB; below it is nothing to see.
const FLOOR_DB: f64 = -120.0;

/// The spectra of all streams.
#[derive(Debug, Serialize)]
pub struct SpectrumEvent {
    /// A stream each.
    pub streams: Vec<Bands>,
}

/// The spectrum of one stream.
#[derive(Debug, Serialize)]
pub struct Bands {
    /// The stream.
    pub source: SourceId,
    /// Where the first band begins, in Hz.
    pub from_hz: f64,
    /// Where the last band ends, in Hz; the edges between lie at equal ratios.
    pub to_hz: f64,
    /// Amplitude of each band in dB of one unit: the root of the summed squares over channels,
    /// without each channel's mean.
    pub db: Vec<f64>,
}

/// The spectra of the newest frames, of every stream that has enough of them.
pub fn spectra(tracer: &Tracer) -> SpectrumEvent {
    let full = |stream: &Stream| stream.recent.len() >= RECENT * stream.channels;
    let of = |(id, stream)| bands(id, stream);
    SpectrumEvent { streams: tracer.streams().filter(|(_, s)| full(s)).map(of).collect() }
}

fn bands(source: &SourceId, stream: &Stream) -> Bands {
    let Stream { rate_hz, channels, recent, .. } = stream;
    let frames = recent.len() / channels;
    let bin_hz = rate_hz / frames as f64;
    let (from_hz, to_hz) = (bin_hz, rate_hz / 2.0);
    let mut power = vec![0.0; frames / 2 + 1];
    for channel in 0..*channels {
        let samples = || recent.iter().skip(channel).step_by(*channels).map(|&x| f64::from(x));
        let mean = samples().sum::<f64>() / frames as f64;
        // Hann's window, at twice its height so that a tone keeps its amplitude.
        let turn = std::f64::consts::TAU / frames as f64;
        let windowed: Vec<f64> = samples()
            .enumerate()
            .map(|(i, x)| (x - mean) * (1.0 - (turn * i as f64).cos()))
            .collect();
        let amplitudes = amplitude_spectrum(windowed.into_iter(), *rate_hz, (0.0, to_hz));
        power.iter_mut().zip(amplitudes).for_each(|(sum, a)| *sum += a * a);
    }
    let edge = |band: usize| from_hz * (to_hz / from_hz).powf(band as f64 / BANDS as f64);
    let index = |hz: f64| ((hz / bin_hz).round() as usize).min(power.len() - 1);
    let db = (0..BANDS).map(|band| {
        let first = index(edge(band));
        // The lowest bands are narrower than a bin, and show the one they lie in.
        let end = index(edge(band + 1)).max(first + 1);
        let sum: f64 = power[first..end].iter().sum();
        let db = (10.0 * sum.log10()).max(FLOOR_DB);
        (10.0 * db).round() / 10.0
    });
    Bands { source: source.clone(), from_hz, to_hz, db: db.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::{Fresh, Trace};

    fn spectrum_of(samples: Vec<f32>) -> SpectrumEvent {
        let mut tracer = Tracer::default();
        let source = SourceId::new("ac").unwrap();
        let fresh = Fresh { source, rate_hz: 10_000.0, channels: 1, start: 0, samples };
        tracer.add(&Trace { fresh: vec![fresh] });
        spectra(&tracer)
    }

    #[test]
    fn a_tone_stands_out_in_its_band_at_its_height() {
        let turn = std::f64::consts::TAU * 1000.0 / 10_000.0;
        let tone = (0..RECENT).map(|i| 5.0 + 0.1 * (turn * i as f64).sin() as f32).collect();
        let event = spectrum_of(tone);
        let Bands { from_hz, to_hz, db, .. } = &event.streams[0];
        let peak = (0..db.len()).max_by(|&a, &b| db[a].total_cmp(&db[b])).unwrap();
        let hz = from_hz * (to_hz / from_hz).powf((peak as f64 + 0.5) / db.len() as f64);
        assert!((hz / 1000.0).ln().abs() < 0.05, "{hz} Hz");
        // Hann spreads a tone over three bins, whose squares sum to 1.5 of the tone's.
        assert!((db[peak] - (-20.0 + 1.76)).abs() < 1.0, "{} dB", db[peak]);
        assert!(db[5] < -70.0, "the mean is not shown: {} dB", db[5]);
    }

    #[test]
    fn silence_is_the_floor_and_too_few_frames_are_nothing() {
        assert!(spectrum_of(vec![0.0; RECENT]).streams[0].db.iter().all(|&db| db == FLOOR_DB));
        assert!(spectrum_of(vec![0.0; RECENT - 1]).streams.is_empty());
    }
}
