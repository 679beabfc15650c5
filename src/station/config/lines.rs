//! `[[lines]]`: sensors that print lines of numbers.

use std::collections::BTreeMap;

use toml::Spanned;

use super::LinesConfig;
use super::file::{LinesBlock, StationFile};
use super::resolve::{Mistake, known, mistake, positive};
use crate::device::lines::{Column, Count, LinesAddress, LinesStream, Survey};
use crate::scene::{Scene, SourceId};

/// Gives each source of a `[[lines]]` block a description if the file has none, and as many channels
/// as it has columns unless the file says how many.
pub(super) fn describe(file: &mut StationFile) {
    for (name, columns) in file.lines.iter().flat_map(|lines| &lines.sources) {
        let of = || Spanned::new(columns.span(), Default::default());
        let block = file.sources.entry(name.clone()).or_insert_with(of);
        block.get_mut().channels.get_or_insert(columns.get_ref().len());
    }
}

/// One sensor of the file.
pub(super) fn lines(block: &LinesBlock, scene: &Scene) -> Result<LinesConfig, Mistake> {
    let LinesBlock { port, rate_hz, counter, time_us, sources, scale } = block;
    let address = match port.get_ref().parse() {
        Ok(address) => address,
        Err(problem) => return mistake(port, format!("port: {problem}")),
    };
    let rate_hz = rate_hz.as_ref().map(|rate_hz| positive("rate_hz", rate_hz)).transpose()?;
    let count = match (counter, time_us) {
        (Some(_), Some(time)) => {
            return mistake(time, "both counter and time_us; expected one of them");
        }
        (Some(column), None) => Some(Count::Rows(checked(column)?.clone())),
        (None, time) => time.as_ref().map(checked).transpose()?.cloned().map(Count::Micros),
    };
    if sources.is_empty() {
        let problem = "it makes no source; expected for example [lines.sources] sensor = [1, 2, 3]";
        return mistake(port, problem);
    }
    stray(scale, sources)?;
    let mut streams = Vec::new();
    for (name, columns) in sources {
        let id = known(name, columns, scene)?;
        let expected = scene.get(name).map_or(0, |spec| spec.channels);
        let found = columns.get_ref().len();
        if found != expected {
            let problem = format!("{name}: columns: {found}, but the source has {expected}");
            return mistake(columns, problem);
        }
        for column in columns.get_ref() {
            place(column).or_else(|problem| mistake(columns, format!("{name}: {problem}")))?;
        }
        let scale = scale.get(name).map(|scale| positive("scale", scale)).transpose()?;
        streams.push(LinesStream { id, columns: columns.get_ref().clone(), scale });
    }
    Ok(LinesConfig { address, rate_hz, count, streams })
}

fn stray(
    scale: &BTreeMap<String, Spanned<f64>>,
    sources: &BTreeMap<String, Spanned<Vec<Column>>>,
) -> Result<(), Mistake> {
    match scale.iter().find(|(name, _)| !sources.contains_key(*name)) {
        Some((name, value)) => mistake(value, format!("`{name}` is no source of [lines.sources]")),
        None => Ok(()),
    }
}

fn place(column: &Column) -> Result<(), String> {
    match column {
        Column::Place(0) => Err("column 0; columns are counted from 1".into()),
        _ => Ok(()),
    }
}

fn checked(column: &Spanned<Column>) -> Result<&Column, Mistake> {
    place(column.get_ref()).or_else(|problem| mistake(column, problem))?;
    Ok(column.get_ref())
}

/// Name of the source that all measuring columns make, where nobody has named any.
const SENSOR: &str = "sensor";

/// The configuration of a station that has this sensor alone, as a survey found it.
///
/// # Errors
/// If its rate cannot be measured, or nothing measures; why, and what to do.
pub fn fitting(address: &LinesAddress, survey: &Survey) -> Result<String, String> {
    // Letters alone.
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
    let names: Vec<&str> = (stream.columns.iter())
        .filter_map(|column| match column {
            Column::Place(place) => survey.names().get(place - 1).map(String::as_str),
            Column::Name(name) => Some(name),
        })
        .collect();
    let names = if names.is_empty() { String::new() } else { format!(" # {}", names.join(", ")) };
    Ok(format!(
        "# A station with one sensor that prints lines of numbers.\nformat = 1\n\n\
         [stylus]\npresent = false\n\n[microphone]\npresent = false\n\n[camera]\npresent = false\n\n\
         [[lines]]\nport = {}\nrate_hz = {rate_hz:?}\n{count}\n\
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

    fn parse(text: &str) -> Result<StationConfig, String> {
        let path = Path::new("station.toml");
        StationConfig::parse(text, path).map_err(|error| error.to_string())
    }

    #[test]
    fn what_a_survey_finds_is_a_configuration() {
        let mut survey = Survey::new(false);
        survey.feed(b"n,\"ax\",ay\n", 0.0);
        for at in 0..2000_u64 {
            let x = (at as f64 * 0.7).sin();
            survey.feed(format!("{},{x:.2},{:.1}\n", at % 256, -x).as_bytes(), at as f64 * 2.5e-3);
        }
        let text = fitting(&"/dev/ttyUSB\"0@9600".parse().unwrap(), &survey).unwrap();
        assert!(text.contains("sensor = [2, 3] # ax, ay"), "{text}");
        let config = parse(&text).unwrap();
        let LinesConfig { address, rate_hz, count, streams } = &config.lines[0];
        assert_eq!(address.to_string(), "/dev/ttyUSB\"0@9600");
        assert_eq!((*rate_hz, count), (Some(400.0), &Some(Count::Rows(Column::Place(1)))));
        assert_eq!(streams[0].scale, Some(0.01));
        assert!(config.stylus.is_none() && config.microphone.is_none() && config.camera.is_none());
        assert_eq!(config.scene.get(SENSOR).unwrap().channels, 2);
        let (cut, group) = (&config.detection.cuts[0], &config.detection.groups[0]);
        assert_eq!((cut.source.as_str(), cut.channels), (SENSOR, 2));
        assert_eq!(group[0].0.as_str(), SENSOR);
    }

    #[test]
    fn a_known_source_and_what_shows_contact_can_be_said() {
        let config = parse(
            "format = 1\n[stylus]\npresent = false\n[[lines]]\nport = \"udp://0.0.0.0:5005\"\ntime_us = \"t\"\n\
             [lines.sources]\nac = [\"ax\", \"ay\"]\nload = [4]\n\
             [[lines]]\nport = \"COM3\"\n[lines.sources]\ntilt = [1]\n\
             [detection]\nlisten = { load = \"force\" }\n[sources.ac]\nband_hz = [5, 100]\n",
        )
        .unwrap();
        assert_eq!(config.scene.get("ac").unwrap().channels, 2);
        assert_eq!(config.scene.get("ac").unwrap().domain.band_hz(), Some((5.0, 100.0)));
        let groups: Vec<_> = config.detection.groups.iter().map(|group| group.len()).collect();
        // Where something is said of a sensor, only that shows contact.
        assert_eq!((groups, config.lines.len()), (vec![1, 1], 2));
    }

    #[test]
    fn mistakes_are_refused_with_their_line() {
        for (lines, part) in [
            ("port = \"auto\"", "line 3: port: `auto`"),
            ("port = \"-\"", "line 3: it makes no source"),
            ("port = \"-\"\nrate_hz = 0\nsources = { a = [1] }", "line 4: rate_hz = 0"),
            ("port = \"-\"\nsources = { a = [0] }", "counted from 1"),
            ("port = \"-\"\nsources = { a = [] }", "line 4: source `a`: channels = 0"),
            ("port = \"-\"\ncounter = 1\ntime_us = 2\nsources = { a = [3] }", "one of them"),
            (
                "port = \"-\"\nsources = { a = [1] }\nscale = { b = 1.0 }",
                "line 5: `b` is no source",
            ),
            ("port = \"-\"\nspeed = 1", "unknown field `speed`"),
        ] {
            let refused = parse(&format!("format = 1\n[[lines]]\n{lines}\n")).unwrap_err();
            assert!(refused.contains(part), "{lines}: {refused}");
        }
    }
}
