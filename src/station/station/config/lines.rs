//! `[[lines]]`: sensors that send lines of numbers as text.

use std::path::PathBuf;

use toml::Spanned;

use super::LinesConfig;
use super::file::{
    LinesBlock, Mistake, StationFile, mistake, no_stray, parsed, positive, source_of,
};
use crate::device::lines::{Column, Count, LinesAddress, LinesStream, Survey};
use crate::device::serial::Selector;
use crate::scene::{Scene, SourceId};

/// Adds a description for each source of a `[[lines]]` block that has none. A source has one
/// channel for each of its columns, unless the file gives the number.
pub(super) fn describe(file: &mut StationFile) {
    for (name, columns) in file.lines.iter().flat_map(|lines| &lines.sources) {
        let of = || Spanned::new(columns.span(), Default::default());
        let block = file.sources.entry(name.clone()).or_insert_with(of);
        block.get_mut().channels.get_or_insert(columns.get_ref().len());
    }
}

pub(super) fn lines(block: &LinesBlock, scene: &Scene) -> Result<LinesConfig, Mistake> {
    let LinesBlock { port, rate_hz, counter, time_us, decimal, sources, scale } = block;
    let address = parsed("port", port)?;
    let rate_hz = rate_hz.as_ref().map(|rate_hz| positive("rate_hz", rate_hz)).transpose()?;
    let count = match (counter, time_us) {
        (Some(_), Some(time)) => {
            return mistake(time, "both counter and time_us; expected one of them");
        }
        (Some(column), None) => Some(Count::Rows(checked(column)?.clone())),
        (None, time) => time.as_ref().map(checked).transpose()?.cloned().map(Count::Micros),
    };
    let decimal_comma = match decimal.as_ref().map(|sign| (sign, sign.get_ref().as_str())) {
        None => None,
        Some((_, ",")) => Some(true),
        Some((_, ".")) => Some(false),
        Some((sign, other)) => {
            return mistake(sign, format!("decimal = \"{other}\"; expected \".\" or \",\""));
        }
    };
    if sources.is_empty() {
        let problem = "it makes no source; expected for example [lines.sources] sensor = [1, 2, 3]";
        return mistake(port, problem);
    }
    no_stray(scale, sources, "[lines.sources]")?;
    let mut streams = Vec::new();
    for (name, columns) in sources {
        let id = source_of(name, "columns", columns, scene)?;
        if columns.get_ref().contains(&Column::Place(0)) {
            return mistake(columns, format!("{name}: {NO_COLUMN}"));
        }
        let scale = scale.get(name).map(|scale| positive("scale", scale)).transpose()?;
        streams.push(LinesStream { id, columns: columns.get_ref().clone(), scale });
    }
    Ok(LinesConfig { address, rate_hz, count, decimal_comma, streams })
}

/// Refuses two sensors at one port, since each would get a part of its lines. A port may have several
/// names, which are links.
pub(super) fn no_shared_port(blocks: &[LinesBlock], lines: &[LinesConfig]) -> Result<(), Mistake> {
    let real = |address: &LinesAddress| match address {
        LinesAddress::Serial(Selector::Path(path), _) => {
            let path: PathBuf = path.canonicalize().unwrap_or_else(|_| path.clone());
            LinesAddress::Serial(Selector::Path(path), 0)
        }
        LinesAddress::Serial(port, _) => LinesAddress::Serial(port.clone(), 0),
        other => other.clone(),
    };
    let ports: Vec<LinesAddress> = lines.iter().map(|lines| real(&lines.address)).collect();
    match (0..ports.len()).find(|at| ports[..*at].contains(&ports[*at])) {
        Some(at) => {
            let problem = "another [[lines]] has this port; name all of its columns in one of them";
            mistake(&blocks[at].port, problem)
        }
        None => Ok(()),
    }
}

const NO_COLUMN: &str = "column 0; columns are counted from 1";

fn checked(column: &Spanned<Column>) -> Result<&Column, Mistake> {
    match column.get_ref() {
        Column::Place(0) => mistake(column, NO_COLUMN),
        column => Ok(column),
    }
}

/// The name given to the source of all measuring columns, if the user named no source.
const SENSOR: &str = "sensor";

/// The configuration text for a station with only this sensor, from a survey of its lines.
/// Fails if the lines cannot be read, the sensor's rate cannot be measured, or no column measures.
pub fn fitting(address: &LinesAddress, survey: &Survey) -> Result<String, String> {
    if let Some(problem) = survey.problem() {
        return Err(problem);
    }
    // The name consists of letters only, so it is a valid id.
    let id = SourceId::new(SENSOR).expect("letters name a source");
    let Some(stream) = survey.stream(id) else {
        return Err("no column measures: each only counts, or holds no numbers".into());
    };
    let rate_hz = survey.rate_hz()?;
    let list = |columns: &[Column]| {
        let places = columns.iter().map(|column| match column {
            Column::Place(place) => place.to_string(),
            Column::Name(name) => toml::Value::from(name.as_str()).to_string(),
        });
        places.collect::<Vec<_>>().join(", ")
    };
    let count = match survey.count() {
        Some(Count::Rows(column)) => format!("counter = {}\n", list(&[column])),
        Some(Count::Micros(column)) => format!("time_us = {}\n", list(&[column])),
        None => String::new(),
    };
    let decimal = if survey.has_decimal_commas() { "decimal = \",\"\n" } else { "" };
    let names: Vec<&str> = (stream.columns.iter())
        .filter_map(|column| match column {
            Column::Place(place) => survey.names().get(place - 1).map(String::as_str),
            // The name itself stands in the list.
            Column::Name(_) => None,
        })
        .collect();
    let names = if names.is_empty() { String::new() } else { format!(" # {}", names.join(", ")) };
    Ok(format!(
        "# A station with one sensor that prints lines of numbers.\nformat = 1\n\n\
         [stylus]\npresent = false\n\n[microphone]\npresent = false\n\n[camera]\npresent = false\n\n\
         [[lines]]\nport = {}\nrate_hz = {rate_hz:?}\n{count}{decimal}\n\
         # Each source, and the columns that are its channels; rename and divide it as you like.\n\
         [lines.sources]\n{SENSOR} = [{}]{names}\n\n\
         # The factor by which its numbers are about 1 at most.\n\
         [lines.scale]\n{SENSOR} = {:?}\n",
        toml::Value::from(address.to_string()),
        list(&stream.columns),
        stream.scale.unwrap_or(1.0),
    ))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::station::config::StationConfig;

    #[test]
    fn what_a_survey_finds_is_a_configuration() {
        let mut survey = Survey::new(false, None);
        survey.feed(b"n,\"ax\",ay\n", 0.0);
        for at in 0..2000_u64 {
            let x = (at as f64 * 0.7).sin();
            survey.feed(format!("{},{x:.2},{:.1}\n", at % 256, -x).as_bytes(), at as f64 * 2.5e-3);
        }
        let text = fitting(&"/dev/ttyUSB\"0@9600".parse().unwrap(), &survey).unwrap();
        assert!(text.contains("sensor = [2, 3] # ax, ay"), "{text}");
        let config = StationConfig::parse(&text, Path::new("station.toml")).unwrap();
        let LinesConfig { address, rate_hz, count, streams, .. } = &config.lines[0];
        assert_eq!(address.to_string(), "/dev/ttyUSB\"0@9600");
        assert_eq!((*rate_hz, count), (Some(400.0), &Some(Count::Rows(Column::Place(1)))));
        assert_eq!(streams[0].scale, Some(0.01));
        assert!(config.stylus.is_none() && config.microphone.is_none() && config.camera.is_none());
        assert_eq!(config.scene.get(SENSOR).unwrap().channels, 2);
        let (cut, group) = (&config.detection.cuts[0], &config.detection.groups[0]);
        assert_eq!((cut.source.as_str(), cut.channels), (SENSOR, 2));
        assert_eq!(group[0].0.as_str(), SENSOR);
    }
}
