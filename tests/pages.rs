//! The README and the pages beside it: what they show can be typed, and does what they say.

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use common::write_wav;
use surfaced::library::About;
use surfaced::scene::{LibraryToml, Scene};
use surfaced::station::config::StationConfig;

const README: &str = include_str!("../README.md");

/// The indented blocks of a page, without their indentation.
fn blocks(page: &str) -> Vec<String> {
    let mut blocks = vec![String::new()];
    for line in page.lines() {
        match line.strip_prefix("    ") {
            Some(code) => blocks.last_mut().unwrap().push_str(&format!("{code}\n")),
            // A blank line within a block belongs to it, and so the next block is begun late.
            None if line.is_empty() => blocks.last_mut().unwrap().push('\n'),
            None => blocks.push(String::new()),
        }
    }
    blocks.into_iter().map(|block| block.trim().to_string()).filter(|b| !b.is_empty()).collect()
}

/// The commands below a heading of the README, as far as they need no device.
fn commands(heading: &str) -> Vec<Vec<String>> {
    let section = README.split_once(heading).unwrap().1.split("\n## ").next().unwrap();
    let lines: Vec<String> = blocks(section)
        .iter()
        .flat_map(|b| b.lines().map(String::from).collect::<Vec<_>>())
        .collect();
    let words = |line: &String| {
        let words = line.split("  #").next().unwrap().strip_prefix("surfaced ")?;
        Some(words.split_whitespace().map(String::from).collect())
    };
    lines.iter().filter_map(words).collect()
}

fn surfaced(folder: &Path, args: &[String]) -> Output {
    let program = env!("CARGO_BIN_EXE_surfaced");
    Command::new(program).current_dir(folder).args(args).output().unwrap()
}

#[track_caller]
fn succeeds(folder: &Path, args: &[String]) -> String {
    let output = surfaced(folder, args);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "surfaced {}: {said}", args.join(" "));
    assert!(said.contains("\nnext: "), "surfaced {} says what to do next: {said}", args.join(" "));
    String::from_utf8(output.stdout).unwrap()
}

/// Noise of one colour a surface, as a telephone might record it.
fn record(path: &Path, rate_hz: u32, width: usize, seed: u32) {
    let mut state = seed;
    let mut noise = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        i32::from((state >> 16) as i16) / 8
    };
    let raw: Vec<i32> = (0..4 * rate_hz as usize + width).map(|_| noise()).collect();
    let mean = |window: &[i32]| (window.iter().sum::<i32>() / width as i32) as i16;
    let samples: Vec<i16> = raw.windows(width).map(mean).collect();
    write_wav(path, rate_hz, 1, &samples);
}

#[test]
fn the_first_library_of_the_readme_is_named() {
    let folder = tempfile::tempdir().unwrap();
    for (surface, width) in [("table", 2), ("jeans", 7)] {
        for take in 1..=5 {
            let file = folder.path().join(format!("my-library/{surface}/{take}.wav"));
            record(&file, 44_100, width, take + 10 * width as u32);
        }
    }
    record(&folder.path().join("new/1.wav"), 44_100, 7, 99);
    let all = commands("## Your first library, without a stylus");
    assert_eq!(all.len(), 6);
    let shown: Vec<String> = all[..4].iter().map(|args| succeeds(folder.path(), args)).collect();
    for args in &all[4..] {
        // Exit 3 says that something should be mended; here, that more trials should be recorded.
        let code = surfaced(folder.path(), args).status.code();
        assert!(matches!(code, Some(0 | 3)), "surfaced {}: {code:?}", args.join(" "));
    }
    assert!(shown[0].contains("accuracy   100.0 % (10 of 10"), "{}", shown[0]);
    assert!(shown[1].contains("1/1  jeans"), "{}", shown[1]);
    assert!(folder.path().join("plan.toml").exists());
}

#[test]
fn lmt108_as_a_newcomer_has_it_is_evaluated_without_options() {
    let Some(data) = common::shared_lmt108() else { return };
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path().join("LMT_108_SurfaceMaterials_Database");
    std::os::unix::fs::symlink(data, here).unwrap();
    let all = commands("## LMT108");
    let eval = all.iter().find(|args| args[0] == "eval").unwrap();
    let shown = succeeds(folder.path(), eval);
    assert!(shown.contains("leave-one-trial-out · embedding · mi2"), "{shown}");
    assert!(all.iter().any(|args| args[0] == "replay"), "replay is run by its own tests");
}

#[test]
fn files_of_the_pages_are_read() {
    let (mut libraries, mut trials, mut stations) = (0, 0, 0);
    for block in blocks(include_str!("../src/library/README.md")) {
        if block.starts_with("format = 1") {
            LibraryToml::parse(&block, &Scene::lmt108()).unwrap();
            libraries += 1;
        }
        if block.starts_with("surface = ") {
            let folder = tempfile::tempdir().unwrap();
            std::fs::write(folder.path().join("trial.toml"), &block).unwrap();
            assert_eq!(About::read(folder.path()).unwrap().trial, Some(3));
            trials += 1;
        }
    }
    for block in blocks(include_str!("../configs/README.md")) {
        if block.starts_with("format = 1") {
            StationConfig::parse(&block, Path::new("station.toml")).unwrap();
            stations += 1;
        }
    }
    assert_eq!((libraries, trials, stations), (1, 1, 1));
}

#[test]
fn links_of_the_pages_lead_somewhere() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let pages = ["README.md", "src/library/README.md", "src/serve/README.md"];
    let more = ["src/evaluate/README.md", "configs/README.md", "tools/python/README.md"];
    for page in pages.iter().chain(&more).chain(&[".github/CONTRIBUTING.md", "firmware/README.md"])
    {
        let file = root.join(page);
        let text = std::fs::read_to_string(&file).unwrap();
        for link in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let target = link.split('#').next().unwrap();
            if target.starts_with("http") || target.is_empty() {
                continue;
            }
            let path: PathBuf = file.parent().unwrap().join(target);
            assert!(path.exists(), "{page} links to {link}");
        }
    }
}

#[test]
fn the_embedded_scene_explains_itself() {
    let folder = tempfile::tempdir().unwrap();
    let output = surfaced(folder.path(), &["replay".into()]);
    let said = String::from_utf8_lossy(&output.stderr);
    let shown = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{said}");
    for part in ["are almost alike", "is not in the library", "the accelerometer is dead"] {
        assert!(said.contains(part), "`{part}` is not in: {said}");
    }
    for part in
        ["accuracy ", "unknown  ", "of surfaces that the library lacks", "left out ac of 1 scan"]
    {
        assert!(shown.contains(part), "`{part}` is not in: {shown}");
    }
    assert!(said.contains("ac: channel"), "the dead sensor is said: {said}");
}
