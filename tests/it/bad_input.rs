//! Files that cannot be used: each with the message that a person sees.

use std::path::{Path, PathBuf};

use crate::common::{open, picture, says, temp, write_file, write_wav};
use surfaced::dataset;
use surfaced::scene::Scene;
use surfaced::trial::Signal;

/// The message when a library is opened and its first trial is read.
#[track_caller]
fn refusal(path: &Path) -> String {
    match open(path).and_then(|library| library.entries[0].load()) {
        Err(error) => error.to_string(),
        Ok(trial) => panic!("must be refused, but was read: {}", trial.key),
    }
}

/// The message about a library of one file with these bytes.
#[track_caller]
fn refusal_of(name: &str, bytes: &[u8]) -> String {
    let (_dir, path) = temp();
    let file = path.join("Oak/1").join(name);
    write_file(&file, bytes);
    let message = refusal(&path);
    says(&message, &[&file.display().to_string()]);
    message
}

fn wav_bytes(samples: &[i16]) -> Vec<u8> {
    let (_dir, path) = temp();
    write_wav(&path.join("x.wav"), 44_100, 1, samples);
    std::fs::read(path.join("x.wav")).unwrap()
}

fn encoded(format: image::ImageFormat, width: u32, height: u32) -> Vec<u8> {
    let Signal::Image(noise) = picture(3) else { panic!("a picture is an image") };
    let rgb: Vec<u8> =
        noise.rgb().iter().cycle().take((width * height * 3) as usize).copied().collect();
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::RgbImage::from_raw(width, height, rgb).unwrap().write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

#[test]
fn an_empty_file() {
    says(&refusal_of("mi2.wav", b""), &["the file is empty (0 bytes); record again, or remove it"]);
    says(&refusal_of("ca1.png", b""), &["the file is empty (0 bytes)"]);
}

#[test]
fn a_truncated_wav() {
    let whole = wav_bytes(&[1; 1000]);
    says(
        &refusal_of("mi2.wav", &whole[..1044]),
        &[
            "truncated: the file ends before what its header promises (1000 of 2000 bytes of samples)",
        ],
    );
    for end in [4, 11, 20, 30, 43, 44, 45] {
        says(&refusal_of("mi2.wav", &whole[..end]), &["truncated"]);
    }
}

#[test]
fn a_wav_without_samples() {
    says(
        &refusal_of("mi2.wav", &wav_bytes(&[])),
        &["it holds no samples; record again, or remove"],
    );
}

#[test]
fn a_file_that_is_no_wav() {
    says(
        &refusal_of("mi2.wav", &[b'x'; 200]),
        &["not a WAV file that can be read", "expected 16-bit"],
    );
}

#[test]
fn a_nan_or_an_infinity() {
    let (_dir, path) = temp();
    let file = path.join("Oak/1/fr.wav");
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    let spec = hound::WavSpec {
        channels: 2,
        sample_rate: 10_000,
        bits_per_sample: 32,
        sample_format: hound::SampleFormat::Float,
    };
    for (bad, name) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf")] {
        let mut writer = hound::WavWriter::create(&file, spec).unwrap();
        [0.0, 0.0, 0.0, 0.0, 0.0, bad].iter().for_each(|&x: &f32| writer.write_sample(x).unwrap());
        writer.finalize().unwrap();
        says(
            &refusal(&path),
            &["fr.wav", &format!("channel 2 is {name} at sample 3"), "check the connector"],
        );
    }
}

#[test]
fn a_wrong_number_of_channels() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/1/ac.wav"), 10_000, 1, &[1, 2]);
    says(
        &refusal(&path),
        &[
            "ac.wav: 1 channel, but source `ac` has 3; expected one channel for each column",
            "[sources.ac] channels = 1",
        ],
    );
    write_file(&path.join("library.toml"), "format = 1\n[sources.ac]\nchannels = 1\n");
    open(&path).unwrap();
}

#[test]
fn two_rates_in_one_source_are_said_and_refused_where_a_declared_band_is_not_there() {
    let (_dir, path) = temp();
    write_wav(&path.join("Ash/1/mi2.wav"), 44_100, 1, &[1, 2]);
    write_wav(&path.join("Oak/1/mi2.wav"), 48_000, 1, &[1, 2]);
    let remarks = open(&path).unwrap().remarks.join("\n");
    says(
        &remarks,
        &[
            "Oak/1/mi2.wav: source `mi2` has 48000 Hz here, but 44100 Hz in",
            "Ash/1/mi2.wav",
            "`embedding` compares them by frequency in Hz, the others need one rate",
        ],
    );
    write_wav(&path.join("Yew/1/mi2.wav"), 8_000, 1, &[1, 2]);
    let library = open(&path).unwrap();
    says(
        &library.remarks.join("\n"),
        &["source `mi2`: compared up to 4000 Hz, half of its lowest rate"],
    );
    let band_hz = library.scene.get("mi2").unwrap().domain.band_hz();
    assert_eq!(band_hz, Some((0.0, 4000.0)));
    let declared = "format = 1\n[sources.mi2]\nband_hz = [0, 7500]\n";
    write_file(&path.join("library.toml"), declared);
    says(&refusal(&path), &["Yew/1/mi2.wav", "reaches above half of that"]);
}

#[test]
fn a_rate_that_library_toml_does_not_allow() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/1/ir.wav"), 5_000, 1, &[1, 2]);
    open(&path).unwrap();
    write_file(
        &path.join("library.toml"),
        "format = 1\n[sources.ir]\ndomain = \"time\"\nrate_hz = 2200",
    );
    says(
        &refusal(&path),
        &["ir.wav", "5000 Hz, but library.toml says rate_hz = 2200 for source `ir`"],
    );
}

#[test]
fn a_picture_of_another_size() {
    says(
        &refusal_of("ca1.png", &encoded(image::ImageFormat::Png, 640, 480)),
        &["the image is 640×480 pixels; expected 320 wide and 480 high"],
    );
}

#[test]
fn a_damaged_picture() {
    for (name, format) in
        [("ca1.png", image::ImageFormat::Png), ("ca1.jpg", image::ImageFormat::Jpeg)]
    {
        let whole = encoded(format, 320, 480);
        for bytes in
            [&whole[..whole.len() / 2], &whole[..whole.len() - 40], &whole[..30], b"not a picture"]
        {
            says(
                &refusal_of(name, bytes),
                &["the picture cannot be decoded", "take it again, or remove it"],
            );
        }
    }
}

#[test]
fn a_file_of_the_wrong_kind() {
    says(&refusal_of("ca1.wav", &wav_bytes(&[1])), &["a WAV file, but source `ca1` is an image"]);
    says(&refusal_of("mi2.png", b"x"), &["a picture, but source `mi2` is not; expected mi2.wav"]);
}

#[test]
fn an_unknown_key_with_its_line() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/1/mi2.wav"), 44_100, 1, &[1]);
    write_file(&path.join("Oak/1/trial.toml"), "user = \"me\"\n\ncolour = \"red\"\n");
    says(
        &refusal(&path),
        &["trial.toml", "line 3", "unknown field `colour`, expected one of `surface`"],
    );
    write_file(&path.join("Oak/1/trial.toml"), "trial = -1");
    says(&refusal(&path), &["trial.toml", "line 1"]);
    write_file(&path.join("Oak/1/trial.toml"), "");
    write_file(&path.join("library.toml"), "format = 1\nnaem = \"x\"\n");
    says(&refusal(&path), &["library.toml", "line 2", "unknown field `naem`"]);
    let text = "format = 1\n[sources.pac]\ndomain = \"time\"\nalign = true\n";
    write_file(&path.join("library.toml"), text);
    says(&refusal(&path), &["library.toml", "line 4", "unknown field `align`"]);
    write_file(&path.join("library.toml"), b"format = 1\nname = \"\xff\"\n");
    says(&refusal(&path), &["library.toml: line 2: not UTF-8"]);
}

#[test]
fn odd_names() {
    let (_dir, path) = temp();
    write_wav(&path.join("Eiche, geölt (№ 5)!/Versuch 3/mi2.wav"), 44_100, 1, &[1]);
    write_wav(&path.join("-rf/1/mi2.wav"), 44_100, 1, &[1]);
    write_wav(&path.join("-rf/1/mi 2.wav"), 44_100, 1, &[1]);
    let library = open(&path).unwrap();
    assert_eq!(library.surfaces(), ["-rf", "Eiche, geölt (№ 5)!"]);
    assert_eq!(library.entries[1].key.number, 3);
    says(
        &library.remarks[0],
        &["-rf/1/mi 2.wav", "use letters, digits, `_` and `-`; rename the file"],
    );

    write_wav(&path.join("Oak/last/mi2.wav"), 44_100, 1, &[1]);
    says(
        &refusal(&path),
        &["Oak/last", "does not end with the number of the trial", "trial = N", "several takes"],
    );
}

#[cfg(target_os = "linux")]
#[test]
fn a_name_that_is_not_utf8() {
    use std::os::unix::ffi::OsStrExt;
    let (_dir, path) = temp();
    let odd = std::ffi::OsStr::from_bytes;
    std::fs::create_dir(path.join(odd(b"G\xff"))).unwrap();
    says(&refusal(&path), &["not used, its name is not UTF-8; rename it"]);
    write_wav(&path.join("Oak/1/mi2.wav"), 44_100, 1, &[1]);
    for file in [odd(b"a\xff.wav"), odd(b"Oak/b\xff.txt"), odd(b"Oak/1/c\xff.wav")] {
        write_file(&path.join(file), "x");
    }
    let library = open(&path).unwrap();
    assert_eq!(library.entries.len(), 1);
    says(&library.remarks.join("\n"), &["and 3 more: not used, its name is not UTF-8"]);
}

#[test]
fn two_folders_of_one_trial_and_two_files_of_one_source() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/a1/mi2.wav"), 44_100, 1, &[1]);
    write_wav(&path.join("Oak/b1/mi2.wav"), 44_100, 1, &[1]);
    let opened = dataset::open_usable(&path, &Scene::lmt108()).unwrap();
    assert_eq!(opened.library.entries.len(), 1, "one of them is used");
    says(
        &opened.bad[0].to_string(),
        &["Oak/b1: the same trial (Oak · expert · trial 1) as Oak/a1; distinguish them"],
    );
    std::fs::remove_dir_all(path.join("Oak/b1")).unwrap();
    write_file(&path.join("Oak/a1/ca1.jpg"), "x");
    write_file(&path.join("Oak/a1/ca1.png"), "x");
    says(&refusal(&path), &["ca1.png: a second file for source `ca1`"]);
}

#[test]
fn a_folder_with_nothing_in_it() {
    let (_dir, path) = temp();
    says(
        &refusal(&path),
        &[
            "no recordings found; looked for SURFACE/TRIAL/<source>.wav, .flac, .png or .jpg",
            "ac, ca1, ca2, fr, ir, me, mi1, mi2",
            "LMT108",
        ],
    );
    says(
        &refusal(&path.join("nowhere")),
        &["nowhere: there is no such file or folder; check the path"],
    );
    write_file(&path.join("file"), "x");
    says(&refusal(&path.join("file")), &["this is a file; expected a folder of recordings"]);
}

#[cfg(unix)]
#[test]
fn a_file_that_may_not_be_read() {
    use std::os::unix::fs::PermissionsExt;
    let (_dir, path) = temp();
    let file = path.join("Oak/1/mi2.wav");
    write_wav(&file, 44_100, 1, &[1]);
    std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o000)).unwrap();
    if std::fs::read(&file).is_ok() {
        eprintln!("SKIPPED: permission denied, since this user (root?) may read anything");
        return;
    }
    says(&refusal(&path), &["mi2.wav", "permission denied; let yourself read it"]);
}

/// Two surfaces of three trials each, in which two files are damaged: one at its end, one in its
/// samples.
fn with_two_bad_files() -> (tempfile::TempDir, PathBuf) {
    let (dir, path) = temp();
    for surface in ["Oak", "Steel"] {
        for trial in 1..=4 {
            let hum = |i: i32| ((i * (trial + 1) * surface.len() as i32) % 997 * 20) as i16;
            let samples: Vec<i16> = (0..8000).map(hum).collect();
            write_wav(&path.join(format!("{surface}/trial{trial}/mi2.wav")), 44_100, 1, &samples);
        }
    }
    let cut = path.join("Oak/trial1/mi2.wav");
    let bytes = std::fs::read(&cut).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() - 100]).unwrap();
    let spec = hound::WavSpec {
        channels: 1,
        sample_rate: 44_100,
        bits_per_sample: 32,
        sample_format: hound::SampleFormat::Float,
    };
    let mut writer = hound::WavWriter::create(path.join("Steel/trial2/mi2.wav"), spec).unwrap();
    (0..8000).for_each(|i| writer.write_sample(if i == 7 { f32::NAN } else { 0.1 }).unwrap());
    writer.finalize().unwrap();
    (dir, path)
}

#[test]
fn eval_goes_on_without_bad_files_and_names_all_of_them_where_it_is_strict() {
    let (_dir, path) = with_two_bad_files();
    let eval = |more: &[&str]| {
        let mut command = assert_cmd::Command::cargo_bin("surfaced").unwrap();
        command.arg("eval").arg(&path).args(["--protocol", "leave-one-trial-out", "--json"]);
        let output = command.args(more).output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap(), output.stdout)
    };
    let (code, said, _) = eval(&["--strict"]);
    assert_eq!(code, Some(1));
    for part in ["Oak/trial1", "--strict"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    let (code, said, out) = eval(&[]);
    assert_eq!(code, Some(3), "{said}");
    let report: serde_json::Value = serde_json::from_slice(&out).unwrap();
    assert_eq!(report["queries"], 6);
    let warnings = report["warnings"].to_string();
    assert!(warnings.contains("Oak/trial1") && warnings.contains("Steel/trial2"), "{warnings}");
}

#[cfg(unix)]
#[test]
fn a_link_to_nothing_and_a_pipe_are_passed_over_and_said() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/trial1/mi2.wav"), 44_100, 1, &[1, 2, 3]);
    std::os::unix::fs::symlink("nowhere", path.join("Oak/trial1/ac.wav")).unwrap();
    std::os::unix::fs::symlink("nowhere", path.join("Steel")).unwrap();
    let pipe = path.join("Oak/trial1/mi1.wav");
    rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, rustix::fs::Mode::RWXU).unwrap();
    let library = open(&path).unwrap();
    assert_eq!(library.entries[0].sources.len(), 1);
    let said = library.remarks.join("\n");
    assert!(said.contains("a link to nothing") && said.contains("neither a file"), "{said}");
}

#[test]
fn a_band_above_half_the_rate_is_refused_when_the_library_is_opened() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/trial1/pac.wav"), 2000, 1, &[1, 2, 3]);
    let text = "format = 1\n[sources.pac]\ndomain = \"spectrum\"\nband_hz = [1500, 3000]\n";
    write_file(&path.join("library.toml"), text);
    let error = open(&path).unwrap_err().to_string();
    assert!(error.contains("above half") && error.contains("pac.wav"), "{error}");
}
