//! `surfaced eval --paper` on miniatures of LMT108, whole and in shards.

use std::path::{Path, PathBuf};
use std::process::Output;

use crate::common::{write_file, write_wav};
use assert_cmd::Command;
use serde_json::Value;
use surfaced::dataset::synth::{self, Parameters};
use surfaced::trial::{EXPERT, Image, Signal};

const QUICK: [&str; 4] = ["--n", "40", "--repetitions", "1"];

fn eval(args: &[&str]) -> Output {
    Command::cargo_bin("surfaced").unwrap().arg("eval").args(args).output().unwrap()
}

#[track_caller]
fn done(args: &[&str]) -> Output {
    let output = eval(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

/// A synthetic scene in the database's own layout: 3 surfaces, 2 expert trials, 2 users.
fn tree(root: &Path) {
    let scene =
        Parameters { surfaces: 3, trials: 2, users: 2, drag_seconds: 0.1, ..Default::default() };
    for entry in synth::library(&scene).entries {
        let trial = entry.load().unwrap();
        let key = &trial.key;
        let (folder, split) =
            if key.user == EXPERT { ("Training", "train") } else { ("Testing", "test") };
        let (s, n) = (format!("G{}{}", &key.surface[7..8], key.surface), key.number);
        let column = |id: &str, channel: usize| match &trial.signals[id] {
            Signal::Series(series) => {
                series.channel(channel).map(|x| format!("{x}\n")).collect::<String>()
            }
            Signal::Image(_) => String::new(),
        };
        let text = |path: String, id: &str, channel: usize| {
            write_file(&root.join(path), column(id, channel));
        };
        for (channel, axis) in ["X", "Y", "Z"].into_iter().enumerate() {
            let folder = format!("AccelScansComponents/Movement/{folder}");
            text(format!("{folder}/{s}_Movement_{axis}_{split}{n}.txt"), "ac", channel);
        }
        for fsr in [1, 2] {
            let name = format!("{s}_FrictionFSR{fsr}_Movement_{split}{n}.txt");
            text(format!("FricScans/FSR{fsr}/{folder}/{name}"), "fr", fsr - 1);
        }
        text(format!("ReflectanceScans/{folder}/{s}_Reflectance_Movement_{split}{n}.txt"), "ir", 0);
        let metal =
            format!("MetalDetectionScans/{folder}/{s}_MetalDetection_Movement_{split}{n}.txt");
        text(metal, "me", 0);
        for (kind, id) in [("Movement", "mi2"), ("Tapping", "mi1")] {
            let Signal::Series(series) = &trial.signals[id] else { panic!("expected a series") };
            let samples: Vec<i16> = series
                .samples()
                .iter()
                .map(|x| (x * 32767.0).clamp(-32767.0, 32767.0) as i16)
                .collect();
            let path = format!("SoundScans/{kind}/{folder}/{s}_Sound_{kind}_{split}{n}.wav");
            write_wav(&root.join(path), 44_100, 1, &samples);
        }
        for (flash, prefix, id) in [("NoFlash", "", "ca1"), ("Flash", "Flash_", "ca2")] {
            let Signal::Image(image) = &trial.signals[id] else { panic!("expected an image") };
            let (columns, rows) = (Image::COLS as u32, Image::ROWS as u32);
            let picture = image::RgbImage::from_raw(columns, rows, image.rgb().to_vec()).unwrap();
            let mut bytes = std::io::Cursor::new(Vec::new());
            picture.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
            let path =
                format!("ImageScans/{flash}/{folder}/{prefix}{s}_Image_{n}_{split}{}.png", n + 1);
            write_file(&root.join(path), bytes.into_inner());
        }
    }
}

fn row<'a>(report: &'a Value, protocol: &str, name: &str) -> &'a Value {
    let rows = report["rows"].as_array().unwrap();
    let is_it = |row: &&Value| row["protocol"] == protocol && row["name"] == name;
    rows.iter().find(is_it).unwrap_or_else(|| panic!("no row {name}"))
}

#[test]
fn the_tables_run_on_the_database_s_own_files_and_agree_with_eval() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("LMT"), dir.path().join("out"));
    tree(&data);
    let data = data.to_str().unwrap();
    let args = [&[data, "--paper", "--json", "--out", out.to_str().unwrap()], &QUICK[..]].concat();
    let report: Value = serde_json::from_slice(&done(&args).stdout).unwrap();
    let all = row(&report, "expert-vs-users", "all eight");
    assert_eq!(all["published"]["accuracy"], 97.2);
    assert_eq!((&all["queries"], &all["classes"]), (&6.into(), &3.into()));
    for row in report["rows"].as_array().unwrap() {
        assert!(
            row["accuracy_mean"].is_number() && row["missing"] == serde_json::json!([]),
            "{row}"
        );
    }
    for (protocol, name, sources) in [
        ("expert-vs-users", "all eight", "ca1,ca2,mi1,mi2,ac,fr,ir,me"),
        ("all-vs-one-user", "all eight", "ca1,ca2,mi1,mi2,ac,fr,ir,me"),
        ("leave-one-trial-out", "mi2, spectrum, shift", "mi2"),
        ("expert-vs-users", "haptic", "ac,fr"),
    ] {
        let args = [data, "--protocol", protocol, "--sources", sources, "--json"];
        let alone: Value =
            serde_json::from_slice(&done(&[&args[..], &QUICK[..]].concat()).stdout).unwrap();
        let ours = row(&report, protocol, name);
        assert_eq!(ours["accuracy_mean"], alone["accuracy_mean"], "{protocol}, {name}");
        assert_eq!(ours["precision_mean"], alone["precision_mean"], "{protocol}, {name}");
        if protocol == "expert-vs-users" && name == "all eight" {
            assert_eq!(report["confusion"], alone["confusion"]);
        }
    }
    for figure in ["bars.svg", "confusion.svg", "report.json"] {
        assert!(out.join(figure).exists(), "{figure}");
    }
}

/// A report without the command line that made it.
fn without_command(json: &[u8]) -> Value {
    let mut report: Value = serde_json::from_slice(json).unwrap();
    report["made_by"].as_object_mut().unwrap().remove("command").unwrap();
    report
}

/// Two folders hold the same report and, byte for byte, the same figures.
fn are_the_same(one: &Path, other: &Path) {
    let read = |folder: &Path, file: &str| std::fs::read(folder.join(file)).unwrap();
    let [report, other_report] =
        [one, other].map(|folder| without_command(&read(folder, "report.json")));
    assert_eq!(report, other_report);
    for file in ["bars.svg", "confusion.svg"] {
        assert_eq!(read(one, file), read(other, file), "{file}");
    }
}

#[test]
fn shards_join_to_the_same_report_and_a_killed_run_resumes() {
    let dir = tempfile::tempdir().unwrap();
    let folder = |name: &str| -> (PathBuf, String) {
        let path = dir.path().join(name);
        let text = path.to_str().unwrap().to_string();
        (path, text)
    };
    let (tree_at, data) = folder("LMT");
    tree(&tree_at);
    let ((whole, whole_text), (shards, shards_text), (merged, merged_text)) =
        (folder("whole"), folder("shards"), folder("merged"));
    let stdout =
        done(&[&[&data, "--paper", "--out", &whole_text, "--json"], &QUICK[..]].concat()).stdout;
    let shard = |number: &str| {
        let args = [&data, "--paper", "--out", &shards_text, "--shard", number];
        String::from_utf8(done(&[&args[..], &QUICK[..]].concat()).stderr).unwrap()
    };
    assert!(shard("2/3").contains("wrote"));
    // The leftovers of a killed run are no result.
    write_file(&shards.join("shard-0001-of-0003.1.unfinished"), "{\"format\": 1, \"da");
    let refused = eval(&["merge", &shards_text]);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("are missing: 1, 3"));
    for number in ["1/3", "3/3"] {
        assert!(shard(number).contains("wrote"));
    }
    let before =
        std::fs::metadata(shards.join("shard-0002-of-0003.json")).unwrap().modified().unwrap();
    assert!(shard("2/3").contains("done before"));
    let after =
        std::fs::metadata(shards.join("shard-0002-of-0003.json")).unwrap().modified().unwrap();
    assert_eq!(before, after);
    let joined = done(&["merge", &shards_text, "--out", &merged_text, "--json"]).stdout;
    let [joined, stdout] = [joined, stdout].map(|json| without_command(&json));
    assert_eq!(joined, stdout);
    assert_eq!(stdout["made_by"]["library"].as_str().map(str::len), Some(16), "{stdout}");
    are_the_same(&whole, &merged);
    let other = [&data, "--paper", "--out", &shards_text, "--shard", "2/3", "--n", "30"];
    let refused = eval(&other);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("another run"));
}

#[test]
fn data_that_lack_a_source_say_so_row_by_row() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("LMT");
    tree(&root);
    std::fs::remove_dir_all(root.join("ImageScans")).unwrap();
    let args = [&[root.to_str().unwrap(), "--paper", "--json"], &QUICK[..]].concat();
    let output = eval(&args);
    assert_eq!(output.status.code(), Some(3));
    let said = String::from_utf8_lossy(&output.stderr);
    let lacking: Vec<&str> = said.trim_end().lines().rev().take(3).collect();
    assert!(lacking[2].contains(" rows of Table I and "), "{said}");
    assert!(lacking[1].contains("missing: the sources ca1, ca2"), "{said}");
    assert!(lacking[0].contains("LMT108"), "{said}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let all = row(&report, "expert-vs-users", "all eight");
    assert_eq!(all["missing"], serde_json::json!(["ca1", "ca2"]));
    assert!(all["difference_points"].is_null(), "it is another setting than the paper's");
    assert_eq!(row(&report, "expert-vs-users", "visual")["not_run"], "the data lack ca1, ca2");
}

/// Runs a shard again and again, each time killed after a while that is drawn anew, and longer each
/// time; at last it is left alone.
fn shard_that_is_killed(args: &[&str], seed: u64) {
    let draws =
        [seed.wrapping_mul(0x9e37_79b9_7f4a_7c15), seed.wrapping_mul(0xd1b5_4a32_d192_ed03)];
    for round in 0..8u32 {
        let draw =
            (draws[round as usize % 2].rotate_left(7 * round) >> 40) as f64 / (1 << 24) as f64;
        let after = std::time::Duration::from_secs_f64(draw * 0.004 * f64::from(1 << round));
        let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin("surfaced"))
            .arg("eval")
            .args(args)
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap();
        std::thread::sleep(after);
        // One that is done already has left its result, which the next run finds.
        child.kill().unwrap();
        child.wait().unwrap();
    }
    done(args);
}

#[test]
fn shards_that_are_killed_at_random_end_in_the_same_report() {
    let dir = tempfile::tempdir().unwrap();
    let text = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let (data, whole, shards, merged) =
        (text("LMT"), text("whole"), text("shards"), text("merged"));
    tree(Path::new(&data));
    done(&[&[&data, "--paper", "--out", &whole], &QUICK[..]].concat());
    for (seed, number) in ["1/2", "2/2"].into_iter().enumerate() {
        let args = [&data, "--paper", "--out", &shards, "--shard", number];
        shard_that_is_killed(&[&args[..], &QUICK[..]].concat(), seed as u64 + 1);
    }
    done(&["merge", &shards, "--out", &merged]);
    are_the_same(Path::new(&whole), Path::new(&merged));
}
