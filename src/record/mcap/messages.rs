//! The messages of a trial, which tools draw.
//!
//! A message holds a tenth of a second of one source, so that its header adds little. Samples that
//! came with 16 bits are written as whole numbers and a scale, which take half the room of
//! decimals; pictures as JPEG. The files themselves are attached, so nothing is lost here.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::File;
use std::io::BufWriter;

use base64::Engine;
use mcap::Writer;
use mcap::records::MessageHeader;
use serde_json::json;

use crate::jpeg;
use crate::trial::{Image, Series, Signal, Trial};

/// Messages a second.
const MESSAGES_A_SECOND: f64 = 10.0;
/// The value of 1 in samples of 16 bits.
const STEP: f32 = 1.0 / 32768.0;
/// The schema of samples: one list for each channel; value times scale is the sample.
const SAMPLES_SCHEMA: &str = r#"{"title": "surfaced.Samples", "type": "object", "properties": {"rate_hz": {"type": "number"}, "scale": {"type": "number"}, "values": {"type": "array", "items": {"type": "array", "items": {"type": "number"}}}}, "required": ["rate_hz", "scale", "values"]}"#;
/// The schema that viewers know for pictures, <https://docs.foxglove.dev/docs/sdk/schemas/compressed-image>.
const PICTURE_SCHEMA: &str = r#"{"title": "foxglove.CompressedImage", "type": "object", "properties": {"timestamp": {"type": "object", "title": "time", "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0, "maximum": 999999999}}}, "frame_id": {"type": "string"}, "data": {"type": "string", "contentEncoding": "base64"}, "format": {"type": "string"}}}"#;

type McapFile = BufWriter<File>;

/// Writes the messages of a trial, and gives its duration in seconds.
pub fn write(writer: &mut Writer<McapFile>, trial: &Trial, begin_s: f64) -> mcap::McapResult<f64> {
    let mut longest_s = 0.0f64;
    for (source, signal) in &trial.signals {
        let topic = format!("/{source}");
        let key = &trial.key;
        let mut about = BTreeMap::from([
            ("surface".to_string(), key.surface.clone()),
            ("user".to_string(), key.user.clone()),
            ("trial".to_string(), key.number.to_string()),
        ]);
        match signal {
            Signal::Series(series) => {
                about.insert("rate_hz".into(), series.rate_hz().to_string());
                let name = "surfaced.Samples";
                let schema = writer.add_schema(name, "jsonschema", SAMPLES_SCHEMA.as_bytes())?;
                let channel = writer.add_channel(schema, &topic, "json", &about)?;
                samples(writer, channel, series, begin_s)?;
                longest_s = longest_s.max(series.duration_s());
            }
            Signal::Image(image) => {
                let name = "foxglove.CompressedImage";
                let schema = writer.add_schema(name, "jsonschema", PICTURE_SCHEMA.as_bytes())?;
                let channel = writer.add_channel(schema, &topic, "json", &about)?;
                picture(writer, channel, image, begin_s)?;
            }
        }
    }
    Ok(longest_s)
}

fn header(channel_id: u16, sequence: u32, at_s: f64) -> MessageHeader {
    let time = (at_s * 1e9).round() as u64;
    MessageHeader { channel_id, sequence, log_time: time, publish_time: time }
}

fn samples(
    writer: &mut Writer<McapFile>,
    channel: u16,
    series: &Series,
    begin_s: f64,
) -> mcap::McapResult<()> {
    let (channels, rate_hz) = (series.channels(), series.rate_hz());
    let frames = ((rate_hz / MESSAGES_A_SECOND).ceil() as usize).max(1);
    // Multiplying by 2^15 is exact, so samples that are whole numbers then came with 16 bits.
    let whole = series.samples().iter().all(|x| (x / STEP).fract() == 0.0 && x.abs() <= 1.0);
    let scale = if whole { STEP } else { 1.0 };
    for (index, block) in series.samples().chunks(frames * channels).enumerate() {
        let mut text = format!(r#"{{"rate_hz":{rate_hz},"scale":{scale},"values":["#);
        for of_channel in 0..channels {
            text.push_str(if of_channel == 0 { "[" } else { ",[" });
            for (at, sample) in block.iter().skip(of_channel).step_by(channels).enumerate() {
                let comma = if at == 0 { "" } else { "," };
                // Writing to a string cannot fail.
                let _ = match whole {
                    true => write!(text, "{comma}{}", (sample / STEP) as i32),
                    false => write!(text, "{comma}{sample:?}"),
                };
            }
            text.push(']');
        }
        text.push_str("]}");
        let at_s = begin_s + (index * frames) as f64 / rate_hz;
        writer.write_to_known_channel(&header(channel, index as u32, at_s), text.as_bytes())?;
    }
    Ok(())
}

fn picture(
    writer: &mut Writer<McapFile>,
    channel: u16,
    image: &Image,
    begin_s: f64,
) -> mcap::McapResult<()> {
    let jpeg = jpeg::encode(image).map_err(std::io::Error::other)?;
    let data = base64::engine::general_purpose::STANDARD.encode(jpeg);
    let time = json!({ "sec": begin_s as u64, "nsec": (begin_s.fract() * 1e9) as u32 });
    let message = json!({ "timestamp": time, "frame_id": "", "data": data, "format": "jpeg" });
    writer.write_to_known_channel(&header(channel, 0, begin_s), message.to_string().as_bytes())
}
