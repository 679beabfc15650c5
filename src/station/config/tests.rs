use super::*;
use crate::device::serial::Value;
use crate::scan::detect::SensorKind;
use crate::scene::Phase;

#[test]
fn the_embedded_file_describes_a_whole_station() {
    let config = StationConfig::embedded();
    let stylus = config.stylus.unwrap();
    let of_stylus: Vec<_> =
        stylus.streams.iter().map(|s| (s.id.as_str(), s.channels.len(), s.value)).collect();
    let full = |id, channels| (id, channels, Value::FullScale);
    let expected = [full("ac", 3), full("fr", 2), full("ir", 1), ("me", 1, Value::Unit)];
    assert_eq!((stylus.rate_hz, &of_stylus[..]), (10_000, &expected[..]));
    let sources: Vec<_> = config.detection.cuts.iter().map(|cut| cut.source.as_str()).collect();
    assert_eq!(sources, ["ac", "fr", "ir", "me", "mi1", "mi2", "ca1", "ca2"]);
    let tap = config.detection.cuts.iter().find(|cut| cut.source.as_str() == "mi1").unwrap();
    assert_eq!((tap.stream.as_str(), tap.phase), ("sound", Phase::Tap));
    let groups: Vec<Vec<_>> = (config.detection.groups.iter())
        .map(|group| group.iter().map(|(id, feel)| (id.as_str(), *feel)).collect())
        .collect();
    let stylus = vec![("ac", SensorKind::Vibration), ("fr", SensorKind::Force)];
    assert_eq!(groups, [stylus, vec![("sound", SensorKind::Vibration)]]);
}
