//! The configuration of a station: what it says, what it leaves out, and its mistakes.

use std::path::{Path, PathBuf};
use std::process::Command;

use surfaced::device::lines::LinesAddress;
use surfaced::device::serial::Selector;
use surfaced::scene::SourceId;
use surfaced::station::AnswerState;
use surfaced::station::config::{
    AlertCause, CoilAddress, HttpAddress, MqttAddress, Password, StationConfig, TlsFiles,
};

fn parse(text: &str) -> Result<StationConfig, String> {
    StationConfig::parse(text, Path::new("here/stylus.toml")).map_err(|error| error.to_string())
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
    // A table within a block replaces the default table as a whole.
    let one = parse("format = 1\n[stylus.sources]\nir = [\"ir\"]\n").unwrap().stylus.unwrap();
    assert_eq!(one.streams.len(), 1);
    assert!(parse("[stylus]\npresent = false\n").unwrap_err().contains("format"));
    let without = parse("format = 1\n[stylus]\npresent = false\n").unwrap();
    assert_eq!(without.detection.groups.len(), 1, "the microphone leads");
}

#[test]
fn the_page_has_one_default_address_and_one_age_of_stale_answers() {
    let (config, page) = (StationConfig::embedded(), surfaced::serve::Settings::default());
    assert_eq!((config.serve, config.stale_after_s), (page.address, page.stale_after_s));
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
    let public = parse("format = 1\n[page]\npublic_address = \"https://plant/press-3\"").unwrap();
    assert_eq!(public.public_address, Some("https://plant/press-3".parse().unwrap()));
    refused(
        "[page]\npublic_address = \"plant/press-3\"",
        &["line 3", "public_address: expected an"],
    );
    refused("[page]\nstale_after_s = 0.0", &["line 3", "stale_after_s = 0; expected more than 0"]);
    refused("[camera]\nturn = 45", &["line 3", "0, 90, 180 or 270"]);
    refused("[microphone]\nchannel = 0", &["line 3", "counted from 1"]);
    refused("[microphone]\nsources = [\"mi9\"]", &["line 3", "`mi9`", "mi1, mi2"]);
    refused("[detection]\nlisten = { xy = \"force\" }", &["line 3", "`xy`"]);
    refused("[detection]\nonset = 2.0\nquiet = 3.0", &["line 4", "at most onset = 2"]);
    refused("[scan]\nmode = \"always\"", &["line 3", "continuous"]);
    refused("[scan]\nexpected_stay_s = 0.05", &["line 3", "more than hop_s = 0.1"]);
    refused("[scan]\nhop_s = 20", &["line 3", "expected_stay_s = 10"]);
    refused("[detection]\nonset = 2.0", &["line 3", "at most onset = 2"]);
    refused("[stylus]\nport = 3", &["line 3", "string"]);
    refused("stylus = 3", &["line 2"]);
    refused("serve = \"here\"", &["line 2", "127.0.0.1:8080"]);
    refused("[sources.pac]\ndomain = \"spectrum\"", &["line 2", "band_hz"]);
    let future = parse("format = 2").unwrap_err();
    assert!(future.contains("line 1") && future.contains("format = 1"), "{future}");
}

fn only(names: &[&str]) -> StationConfig {
    let sources: Vec<SourceId> = names.iter().map(|name| SourceId::new(name).unwrap()).collect();
    StationConfig::embedded().only(&sources)
}

fn devices(config: &StationConfig) -> [bool; 3] {
    [config.stylus.is_some(), config.microphone.is_some(), config.camera.is_some()]
}

#[test]
fn no_device_is_opened_that_is_not_needed() {
    let sound = only(&["mi1", "mi2"]);
    assert_eq!(devices(&sound), [false, true, false], "the sound itself shows contact");
    assert_eq!(sound.detection.groups.len(), 1);
    assert_eq!(sound.detection.cuts.len(), 2);
    let forces = only(&["fr"]);
    assert_eq!(devices(&forces), [true, false, false]);
    assert_eq!(forces.detection.cuts.len(), 1);
    let picture = only(&["ca1"]);
    assert_eq!(devices(&picture), [true, false, true], "the stylus shows contact");
    assert!(picture.camera.unwrap().flash.is_none());
    let flash = only(&["ca2", "mi2"]);
    assert_eq!(devices(&flash), [true, true, true], "the stylus switches the light");
}

#[test]
fn all_sources_need_the_whole_station() {
    let all = StationConfig::embedded();
    let sources: Vec<_> = all.detection.cuts.iter().map(|cut| cut.source.clone()).collect();
    assert_eq!(all.clone().only(&sources), all);
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
    // If the file names a source as sign of contact, no other source of its sensor is one.
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
        ("port = \"-\"\nsources = { a = [1] }\nscale = { b = 1.0 }", "line 5: `b` is no source"),
        ("port = \"-\"\nspeed = 1", "unknown field `speed`"),
        ("port = \"-\"\nsources = { ac = [1] }", "line 4: two devices make the source ac"),
    ] {
        let refused = parse(&format!("format = 1\n[[lines]]\n{lines}\n")).unwrap_err();
        assert!(refused.contains(part), "{lines}: {refused}");
    }
}

#[test]
fn a_port_has_one_sensor_whatever_it_is_called() {
    let dir = tempfile::tempdir().unwrap();
    let (port, link) = (dir.path().join("port"), dir.path().join("link"));
    std::fs::write(&port, "").unwrap();
    std::os::unix::fs::symlink(&port, &link).unwrap();
    let of = |ports: [&str; 2]| {
        let block =
            |(port, id)| format!("[[lines]]\nport = \"{port}\"\nsources = {{ {id} = [1] }}\n");
        let blocks: String = ports.into_iter().zip(["a", "b"]).map(block).collect();
        parse(&format!("format = 1\n{blocks}"))
    };
    let (port, link) = (port.to_str().unwrap(), link.to_str().unwrap());
    assert!(of([port, "/dev/ttyOTHER"]).is_ok());
    for twice in [[port, &format!("{port}@9600")], [port, link], ["tcp://here:5", "tcp://here:5"]] {
        let refused = of(twice).unwrap_err();
        assert!(refused.contains("line 6: another [[lines]] has this port"), "{refused}");
    }
}

#[test]
fn addresses_are_taken_apart_and_others_refused() {
    let http: HttpAddress = "http://example:9000/a/b?c=d".parse().unwrap();
    assert_eq!((http.host, http.path.as_str()), (("example".into(), 9000), "/a/b?c=d"));
    let https: HttpAddress = "https://example".parse().unwrap();
    assert_eq!(
        (https.to_string().as_str(), https.tls),
        ("https://example:443/", Some(TlsFiles::default()))
    );
    assert_eq!("http://[::1]".parse::<HttpAddress>().unwrap().host, ("::1".into(), 80));
    let mqtt: MqttAddress = "mqtt://me:secret@broker/plant/hall-3".parse().unwrap();
    assert_eq!(mqtt.to_string(), "mqtt://broker:1883/plant/hall-3");
    let with = |user: &str, password| Some((user.to_string(), password));
    assert!(mqtt.credentials == with("me", Password::Given("secret".into())));
    assert!(!format!("{mqtt:?}").contains("secret"));
    let (mqtt, http) = ("mqtts://[::1]:8883/hall-3", "http://[fe80::1]:80/answers?a=1");
    assert_eq!(mqtt.parse::<MqttAddress>().unwrap().to_string(), mqtt);
    assert_eq!(http.parse::<HttpAddress>().unwrap().to_string(), http);
    let coil = "modbus://[::1]:502/1/12";
    assert_eq!(coil.parse::<CoilAddress>().unwrap().to_string(), coil);
    let safe: MqttAddress = "mqtts://broker".parse().unwrap();
    assert_eq!(
        (safe.to_string().as_str(), safe.tls),
        ("mqtts://broker:8883/surfaced", Some(TlsFiles::default()))
    );
    for text in ["", "http://anna:x@bell/a", "wss://x/", "http:///x", "broker/x", "ftp://x"] {
        assert!(text.parse::<HttpAddress>().is_err(), "{text}");
    }
    for text in
        ["broker", "mqtt://broker/a+", "mqtt://broker/a//b", "mqtt://broker/a.b", "http://broker/a"]
    {
        assert!(text.parse::<MqttAddress>().is_err(), "{text}");
    }
    for text in ["mqtt://me:se%cret@broker", "mqtt://me:a/secret@broker/b"] {
        let why = text.parse::<MqttAddress>().err().unwrap();
        assert!(why.contains("%40 for @") && !why.contains("cret"), "{why}");
    }
}

#[test]
fn a_password_file_belongs_to_a_user_and_no_mistake_shows_a_password() {
    let outputs = |text: &str| parse(&format!("format = 1\n[outputs]\n{text}")).map(|c| c.outputs);
    let mqtt = outputs("mqtt = \"mqtt://me@b\"\npassword_file = \"pw\"").unwrap().mqtt.unwrap();
    let (_, password) = mqtt.credentials.unwrap();
    assert!(password == Password::File("here/pw".into()));
    for address in ["mqtt://broker", "mqtt://me:secret@broker"] {
        let stray = outputs(&format!("mqtt = \"{address}\"\npassword_file = \"pw\""));
        let why = stray.unwrap_err();
        assert!(why.contains("line 4: password_file: ") && !why.contains("secret"), "{why}");
    }
    let why = outputs("mqtt = \"mqtt://me:sécr@et@broker").unwrap_err();
    assert!(why.contains("me:********@broker") && why.contains("line 3"), "{why}");
}

#[test]
fn certificates_and_header_are_of_the_outputs_that_can_use_them() {
    let outputs = |text: &str| parse(&format!("format = 1\n[outputs]\n{text}")).map(|c| c.outputs);
    let both = "http = \"https://a\"\nmqtt = \"mqtts://b\"\nca = \"ca\"\nheader_file = \"h\"";
    let both = outputs(both).unwrap();
    let (http, mqtt) = (both.http.unwrap(), both.mqtt.unwrap());
    assert_eq!(http.header_file, Some("here/h".into()));
    assert_eq!(http.tls, Some(TlsFiles { ca: Some("here/ca".into()), client: None }));
    assert_eq!(mqtt.tls, http.tls);
    for (stray, part) in [
        ("mqtt = \"mqtts://b\"\nheader_file = \"h\"", "line 4: header_file: it goes with `http`"),
        ("http = \"http://a\"\nca = \"ca\"", "line 4: certificates are for TLS"),
    ] {
        let why = outputs(stray).unwrap_err();
        assert!(why.contains(part), "{why}");
    }
}

#[test]
fn a_rule_for_alerts_says_when_and_to_whom_and_is_refused_where_nobody_would_hear_of_it() {
    let alerts =
        |text: &str| parse(&format!("format = 1\n[[alert]]\n{text}")).map(|c| c.outputs.alerts);
    let rule = "name = \"reject\"\nstate = \"unknown\"\nscans = 2\nof = 3\ncooldown_s = 0.5\n\
                http = \"https://bell\"\nheader_file = \"h\"\nmodbus = \"modbus://plc/1/12\"\n\
                [outputs]\nca = \"ca\"";
    let rule = alerts(rule).unwrap().pop().unwrap();
    assert_eq!((rule.on, rule.scans, rule.of), (AlertCause::State(AnswerState::Unknown), 2, 3));
    let http = rule.http.unwrap();
    assert_eq!(http.tls.unwrap().ca, Some("here/ca".into()));
    assert_eq!(http.header_file, Some("here/h".into()));
    assert_eq!(rule.coil.unwrap().to_string(), "modbus://plc:502/1/12");
    let seconds = [rule.cooldown, rule.hold].map(|time| time.as_secs_f64());
    assert_eq!(seconds, [0.5, 2.0]);
    let oak = "name = \"oak\"\nsurface = \"oak\"\n[outputs]\nmqtt = \"mqtt://b\"";
    assert_eq!(alerts(oak).unwrap()[0].on, AlertCause::Surface("oak".into()));
    let bell = "http = \"http://bell\"";
    let drift = format!("name = \"worn\"\non = \"drift\"\n{bell}");
    assert_eq!(alerts(&drift).unwrap()[0].on, AlertCause::Drift);
    for (text, part) in [
        ("name = \"a b\"\nstate = \"unknown\"", "line 3: name: use 1 to 64 letters"),
        ("name = \"a\"", "line 3: give one of `state`, such as \"unknown\", `surface`, and"),
        ("name = \"a\"\non = \"drift\"\nsurface = \"oak\"", "line 3: give one of `state`"),
        ("name = \"a\"\non = \"wear\"", "unknown variant `wear`"),
        (&format!("{drift}\nof = 3"), "line 6: `scans` and `of` count answers"),
        ("name = \"a\"\nstate = \"lost\"", "unknown variant `lost`"),
        ("name = \"a\"\nstate = \"unknown\"", "line 3: nobody would hear of it"),
        ("name = \"a\"\nstate = \"unknown\"\nscans = 3\nof = 2", "line 5: scans = 3, of = 2;"),
        ("name = \"a\"\nstate = \"unknown\"\nscans = 0", "line 5: scans = 0, of = 0;"),
        ("name = \"a\"\nstate = \"unknown\"\nhold_s = 1", "hold_s: it goes with `modbus`"),
        ("name = \"a\"\nstate = \"unknown\"\nmodbus = \"plc/1\"", "modbus: expected host, unit"),
        ("name = \"a\"\nstate = \"unknown\"\nheader_file = \"h\"", "it goes with `http`"),
        (&format!("name = \"a\"\nstate = \"unknown\"\n{bell}\ncooldown_s = -1"), "expected 0 to"),
        (
            &format!(
                "name = \"a\"\nstate = \"unknown\"\n{bell}\n[[alert]]\nname = \"a\"\n\
                 state = \"unsure\"\n{bell}"
            ),
            "line 7: name: another [[alert]] has it",
        ),
    ] {
        let why = alerts(text).unwrap_err();
        assert!(why.contains(part), "{text}: {why}");
    }
}

#[test]
fn an_address_is_a_port_a_host_or_standard_input() {
    for text in ["/dev/ttyACM0", "COM3@9600", "usb:2341:0043@115200", "tcp://robot:5000", "-"] {
        assert_eq!(text.parse::<LinesAddress>().unwrap().to_string(), text);
    }
    let path = |port: &str| Selector::Path(port.into());
    assert_eq!("COM3@9600".parse(), Ok(LinesAddress::Serial(path("COM3"), 9600)));
    assert_eq!("udp://[::]:5000".parse(), Ok(LinesAddress::Udp("[::]:5000".into())));
    for text in ["", "auto", "tcp://robot", "http://a:1", "udp://:x", "COM3@fast", "COM3@0"] {
        let refused = text.parse::<LinesAddress>().unwrap_err();
        assert!(refused.contains("tcp://HOST:PORT"), "{text}: {refused}");
    }
}

/// Runs `systemd-analyze`; `None` where there is none.
fn systemd_analyze(arguments: &[&str], unit: &Path) -> Option<(bool, String)> {
    let done = Command::new("systemd-analyze").args(arguments).arg(unit).output();
    let done = done.inspect_err(|error| eprintln!("skipped: systemd-analyze: {error}")).ok()?;
    Some((done.status.success(), String::from_utf8([done.stdout, done.stderr].concat()).unwrap()))
}

#[test]
fn the_service_is_whole_hardened_and_loads_the_drivers_of_devices_that_are_plugged_in_later() {
    let text = include_str!("../../configs/surfaced.service");
    let allowed = text.lines().filter_map(|line| line.strip_prefix("DeviceAllow=char-"));
    let of_kernel = ["ttyS rw", "ttyAMA rw"];
    let drivers = [
        ("ttyUSB rw", "usbserial"),
        ("ttyACM rw", "cdc_acm"),
        ("alsa rw", "snd"),
        ("video4linux rw", "videodev"),
    ];
    let known = drivers.map(|(group, _)| group);
    assert!(allowed.eq(of_kernel.into_iter().chain(known)));
    for key in ["Wants=", "After="] {
        let lines: String = text.lines().filter(|line| line.starts_with(key)).collect();
        assert!(drivers.iter().all(|(_, module)| lines.contains(&format!("modprobe@{module}."))));
    }
    let folder = tempfile::tempdir().unwrap();
    let unit = folder.path().join("surfaced.service");
    std::fs::write(&unit, text.replace("/usr/bin/surfaced", "/bin/true")).unwrap();
    for arguments in [&["verify"][..], &["security", "--offline=true", "--threshold=20"]] {
        let Some((is_good, said)) = systemd_analyze(arguments, &unit) else { return };
        assert!(is_good, "{arguments:?}: {said}");
    }
}
