use std::path::PathBuf;

use super::*;
use crate::device::serial::Selector;
use crate::scan::detect::{DetectorConfig, SensorKind};
use crate::scene::Phase;

fn parse(text: &str) -> Result<StationConfig, String> {
    StationConfig::parse(text, Path::new("here/stylus.toml")).map_err(|error| error.to_string())
}

#[test]
fn the_embedded_file_describes_a_whole_station() {
    let config = StationConfig::embedded();
    let stylus = config.stylus.unwrap();
    let default = crate::device::serial::default_streams();
    assert_eq!((stylus.rate_hz, stylus.streams), (crate::device::serial::RATE_HZ, default));
    assert_eq!(config.detection.detector, DetectorConfig::default());
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

#[test]
fn what_a_file_leaves_out_is_the_default_and_what_it_says_holds() {
    let embedded = StationConfig::embedded();
    assert_eq!(parse("format = 1").unwrap(), embedded);
    let text = "format = 1\nlibrary = \"mine\"\n[stylus]\nport = \"/dev/ttyACM0\"\n[camera]\npresent = false\n";
    let config = parse(text).unwrap();
    assert_eq!(config.library, Some(PathBuf::from("here/mine")));
    assert_eq!(config.stylus.as_ref().unwrap().port, Selector::Path("/dev/ttyACM0".into()));
    assert_eq!(config.stylus.unwrap().streams, embedded.stylus.unwrap().streams);
    assert!(config.camera.is_none() && config.detection.cuts.len() == 6);
    // A table within a block replaces the default one as a whole.
    let one = parse("format = 1\n[stylus.sources]\nir = [\"ir\"]\n").unwrap().stylus.unwrap();
    assert_eq!(one.streams.len(), 1);
    assert!(parse("[stylus]\npresent = false\n").unwrap_err().contains("format"));
    let without = parse("format = 1\n[stylus]\npresent = false\n").unwrap();
    assert_eq!(without.detection.groups.len(), 1, "the microphone leads");
}

#[test]
fn the_page_has_one_default_address() {
    assert_eq!(StationConfig::embedded().serve, crate::serve::Settings::default().address);
}

#[test]
fn mistakes_are_reported_with_their_line() {
    let refused = |text: &str, parts: &[&str]| {
        let error = parse(&format!("format = 1\n{text}")).unwrap_err();
        for part in [&["here/stylus.toml"], parts].concat() {
            assert!(error.contains(part), "expected `{part}` in: {error}");
        }
    };
    refused("[stylus]\nprot = \"auto\"", &["line 3", "unknown field `prot`", "port"]);
    refused("[stylus]\nport = \"usb:zz\"", &["line 3", "usb:0403:6014"]);
    refused("[stylus]\nrate_hz = 0", &["line 3", "rate_hz = 0; expected more than 0"]);
    refused("[stylus.sources]\nac = [\"acc_x\"]", &["line 3", "channels: 1", "has 3"]);
    refused("[stylus.sources]\npac = [\"acc_x\"]", &["line 3", "`pac`", "[sources.pac]"]);
    refused("[camera]\nturn = 45", &["line 3", "0, 90, 180 or 270"]);
    refused("[microphone]\nchannel = 0", &["line 3", "counted from 1"]);
    refused("[microphone]\nsources = [\"mi9\"]", &["line 3", "`mi9`", "mi1, mi2"]);
    refused("[detection]\nlisten = { xy = \"force\" }", &["line 3", "`xy`"]);
    refused("[detection]\nonset = 2.0\nquiet = 3.0", &["line 4", "at most onset = 2"]);
    refused("[detection]\nonset = 2.0", &["line 3", "at most onset = 2"]);
    refused("[stylus]\nport = 3", &["line 3", "string"]);
    refused("stylus = 3", &["line 2"]);
    refused("serve = \"here\"", &["line 2", "127.0.0.1:8080"]);
    refused("[sources.pac]\ndomain = \"spectrum\"", &["line 2", "band_hz"]);
    let future = parse("format = 2").unwrap_err();
    assert!(future.contains("line 1") && future.contains("format = 1"), "{future}");
}
