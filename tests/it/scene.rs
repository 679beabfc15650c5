//! Descriptions of scenes: the embedded one, those of a `library.toml`, and what is refused.

use surfaced::scene::{Domain, LibraryToml, Scene, SourceSpec};

#[test]
fn the_embedded_scene_holds_the_eight_sources() {
    let scene = Scene::lmt108();
    let names: Vec<_> = scene.sources().map(|s| s.id.as_str()).collect();
    assert_eq!(names, ["ac", "ca1", "ca2", "fr", "ir", "me", "mi1", "mi2"]);
    assert_eq!(scene.get("me").unwrap().sigma, Some(1.0));
}

#[test]
fn a_scene_survives_being_written() {
    let scene = Scene::lmt108();
    assert_eq!(Scene::from_toml(&scene.to_library_toml(false)).unwrap(), scene);
}

#[test]
fn numbers_that_nothing_could_work_with_are_refused() {
    for (line, part) in [
        ("rate_hz = 1e300", "rate_hz"),
        ("rate_hz = 0", "rate_hz"),
        ("rate_hz = nan", "rate_hz"),
        ("channels = 0", "channels"),
        ("channels = 1000000000000", "channels"),
        ("weight = 1e300", "weight"),
        ("weight = -1", "weight"),
        ("sigma = 1e-300", "sigma"),
        ("score_offset = inf", "score_offset"),
        ("band_hz = [9, 1]", "low < high"),
        ("band_hz = [1500, 3000]\nrate_hz = 2000", "lower its upper end to 1000"),
    ] {
        let text = format!("format = 1\n\n[sources.pac]\ndomain = \"time\"\n{line}\n");
        let error = Scene::from_toml(&text).unwrap_err().to_string();
        assert!(error.contains("line 3") && error.contains(part), "{line}: {error}");
    }
}

#[test]
fn a_source_that_the_defaults_know_needs_only_what_differs() {
    let of = |lines: &str, name: &str| {
        let text = format!("format = 1\n[sources.{name}]\n{lines}\n");
        let parsed = LibraryToml::parse(&text, &Scene::lmt108());
        parsed.map(|library| library.sources.get(name).unwrap().clone())
    };
    let default = |name: &str| Scene::lmt108().get(name).unwrap().clone();
    let stereo = of("channels = 2", "mi2").unwrap();
    assert_eq!(stereo, SourceSpec { channels: 2, rate_hz: None, ..default("mi2") });
    let band = of("band_hz = [50, 5000]", "mi2").unwrap();
    assert_eq!(band.domain, Domain::Spectrum { band_hz: (50.0, 5000.0) });
    assert!(band.align_mean && band.what == "sound while dragging");
    let anew = of("domain = \"time\"", "mi2").unwrap();
    assert!(
        !anew.align_mean && anew.domain == Domain::Time { band_hz: None },
        "another domain is another source"
    );
    let unknown = of("channels = 2", "pac").unwrap();
    assert_eq!((unknown.domain, unknown.channels), (Domain::Time { band_hz: None }, 2));
    assert_eq!(of("domain = \"image\"", "top").unwrap().channels, 3);
}
