//! Series as WAV files, without loss.

use std::io::Cursor;

use hound::{SampleFormat, WavSpec, WavWriter};

use crate::trial::Series;

const MOST_CHANNELS: usize = 1024;

/// A WAV file: of 16 bits if these hold every sample exactly, else of f32.
///
/// # Errors
/// With the reason, if WAV cannot hold the series, for example because its rate is not whole.
pub(super) fn encode(series: &Series) -> Result<Vec<u8>, String> {
    let rate_hz = series.rate_hz();
    let sample_rate = rate_hz as u32;
    if f64::from(sample_rate) != rate_hz {
        return Err(format!("WAV files hold whole rates, not {rate_hz} Hz; resample it"));
    }
    let (samples, channels) = (series.samples(), series.channels());
    if samples.len() > Series::MOST_SAMPLES || channels > MOST_CHANNELS {
        return Err(format!(
            "{} samples in {channels} channels are too many for a WAV file; expected at most \
             {} and {MOST_CHANNELS}",
            samples.len(),
            Series::MOST_SAMPLES
        ));
    }
    let short: Option<Vec<i16>> = samples.iter().map(|&x| as_i16(x)).collect();
    let (bits_per_sample, sample_format) = match short {
        Some(_) => (16, SampleFormat::Int),
        None => (32, SampleFormat::Float),
    };
    // At most MOST_CHANNELS, so the cast loses nothing.
    let spec = WavSpec { channels: channels as u16, sample_rate, bits_per_sample, sample_format };
    let mut bytes = Cursor::new(Vec::new());
    let write = || -> Result<(), hound::Error> {
        let mut writer = WavWriter::new(&mut bytes, spec)?;
        match short {
            Some(short) => short.into_iter().try_for_each(|x| writer.write_sample(x))?,
            None => samples.iter().try_for_each(|&x| writer.write_sample(x))?,
        }
        writer.finalize()
    };
    write().map_err(|error| error.to_string())?;
    Ok(bytes.into_inner())
}

/// The 16-bit integer that is read back as exactly this sample (value / 2^15), if there is one.
fn as_i16(sample: f32) -> Option<i16> {
    // Casts saturate, so that any sample is safe here.
    let short = (sample * 32768.0) as i16;
    ((f32::from(short) / 32768.0).to_bits() == sample.to_bits()).then_some(short)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_exact_goes_into_16_bits() {
        assert_eq!(as_i16(-1.0), Some(-32768));
        assert_eq!(as_i16(0.5), Some(16384));
        assert_eq!(as_i16(1.0), None);
        assert_eq!(as_i16(-0.0), None);
        assert_eq!(as_i16(0.1), None);
        assert_eq!(as_i16(f32::MAX), None);
    }

    #[test]
    fn a_broken_rate_is_refused() {
        let series = Series::new(0.5, 1, vec![0.0]).unwrap();
        assert!(encode(&series).unwrap_err().contains("not 0.5 Hz"));
    }
}
