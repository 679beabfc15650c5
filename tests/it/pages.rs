//! The README and the pages that it links to: what they show can be typed, and does what they say.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use crate::common::http::Client;
use crate::common::{self, write_file, write_wav};
use surfaced::library::About;
use surfaced::scene::{LibraryToml, Scene};
use surfaced::station::config::StationConfig;

/// Blocks that show something else than commands, by how they begin, and what they are.
const SHOWN: [(&str, &str); 14] = [
    ("my-library/", "a listing of files"),
    ("device ─►", "a drawing of the source code"),
    ("format = 1", "a file, read below"),
    ("surface = ", "a file, read below"),
    ("[outputs]", "a file, read below"),
    ("[[alert]]", "a file, read below"),
    ("[[lines]]", "a file; tests/it/lines.rs has some like it"),
    ("drag for at least", "what the command above it prints for LMT108"),
    ("$ curl ", "requests with their answers, made by tests/it/serve.rs"),
    ("SELECT ", "the same question is asked by tools/many-stations in .ci/run"),
    ("sql", "the same"),
    ("ini", "files for systemd"),
    ("0.12,9.81,3.1 → ", "forms of lines, read by tests/it/line_forms.rs"),
    ("python", "examples, run by tools/python/run in .ci/run"),
];

/// Commands, by how they begin, that are not run here, and why.
const ELSEWHERE: [(&str, &str); 33] = [
    ("surfaced enroll steel ", "needs a stylus; tests/it/run.rs has one on a pseudo-terminal"),
    ("surfaced run --library my-library ", "needs a stylus; tests/it/run.rs has one"),
    ("surfaced devices --watch ", "needs a sensor; tests/it/lines.rs has one"),
    ("surfaced enroll cork ", "the same"),
    ("surfaced run --config ", "the same"),
    ("surfaced run --lines ", "the same"),
    ("arecord ", "needs a sound card; tests/it/lines.rs has one"),
    ("mosquitto_sub ", "needs a broker; tests/it/lines.rs has one"),
    ("ros2 ", "needs ROS; tests/it/lines.rs has what it prints"),
    ("surfaced eval LMT_108_", "needs the recordings; a test below runs it where they are"),
    ("surfaced replay LMT_108_", "takes as long as the recordings; tests/it/ring_and_replay.rs"),
    ("surfaced stress my-library ", "takes minutes; tests/it/stress.rs"),
    ("surfaced eval merge ", "needs what a cluster wrote; tests/it/paper.rs"),
    ("surfaced export ", "needs the feature mcap; tests/mcap.rs"),
    ("surfaced import ", "the same"),
    ("DATA=", "needs a cluster"),
    ("cargo build --release", "builds; .ci/run does"),
    ("cargo test", "runs this very test"),
    ("bash .ci/run", "runs this very test"),
    ("rustup target add ", "installs; .ci/run does"),
    ("cd firmware/stylus", "builds the firmware; .ci/run does"),
    ("probe-rs ", "needs a stylus to flash"),
    ("rust-objcopy ", "needs a stylus to flash"),
    ("dfu-util ", "needs a stylus to flash"),
    ("apt-get install ", "installs; .ci/run does"),
    ("systemctl ", "changes the machine; tools/package-test does so in a Debian of its own"),
    ("tools/qemu-stylus", "needs an emulator; .ci/run runs it"),
    ("tools/peers/run ", "installs 600 MB of packages, and needs the recordings"),
    ("cargo run --release -- replay", "a test below runs the program so"),
    ("surfaced replay --speed 1.0 --serve", "the same"),
    ("surfaced replay --speed 1.0 --config ", "needs a broker; tests/outputs.rs has one"),
    ("surfaced outputs test ", "the same"),
    ("surfaced fleet ", "the same, for tools/many-stations in .ci/run"),
];

/// A page's path within the repository, and its text.
type Page = (PathBuf, String);

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The README, and all that it and they link to.
fn pages() -> Vec<Page> {
    let mut paths = vec![PathBuf::from("README.md")];
    let mut pages: Vec<Page> = Vec::new();
    while let Some(path) = paths.pop() {
        if pages.iter().any(|(known, _)| *known == path) {
            continue;
        }
        let text = std::fs::read_to_string(root().join(&path)).unwrap();
        let folder = root().join(&path).parent().unwrap().to_path_buf();
        for link in links(&text).filter(|link| link.ends_with(".md")) {
            let found = folder.join(link).canonicalize();
            let found = found.unwrap_or_else(|_| panic!("{} links to {link}", path.display()));
            paths.push(found.strip_prefix(root().canonicalize().unwrap()).unwrap().into());
        }
        pages.push((path, text));
    }
    pages.sort();
    pages
}

/// The links of a page, without those to the web.
fn links(page: &str) -> impl Iterator<Item = &str> {
    let all = page.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    all.filter_map(|link| link.split('#').next())
        .filter(|target| !target.starts_with("http") && !target.is_empty())
}

/// The blocks of a page, indented or fenced; those that are fenced begin with their language.
fn blocks(page: &str) -> Vec<String> {
    let mut blocks = vec![String::new()];
    let mut fenced = false;
    for line in page.lines() {
        if let Some(language) = line.strip_prefix("```") {
            fenced = !fenced;
            blocks.push(if fenced { format!("{language}\n") } else { String::new() });
            continue;
        }
        match line.strip_prefix("    ").filter(|_| !fenced).or(fenced.then_some(line)) {
            Some(code) => blocks.last_mut().unwrap().push_str(&format!("{code}\n")),
            // A blank line within a block belongs to it, and so the next block is begun late.
            None if line.is_empty() => blocks.last_mut().unwrap().push('\n'),
            None => blocks.push(String::new()),
        }
    }
    blocks.into_iter().map(|block| block.trim().to_string()).filter(|b| !b.is_empty()).collect()
}

/// The commands that a page shows, without remarks.
fn commands(page: &str) -> Vec<String> {
    let blocks = blocks(page);
    let is_shown = |block: &&String| SHOWN.iter().any(|(begin, _)| block.starts_with(begin));
    let of_block = |block: &String| -> Vec<String> {
        let lines = block.replace("\\\n", " ");
        let bare = lines.lines().map(|line| line.split("  #").next().unwrap().trim());
        bare.filter(|line| !line.is_empty() && !line.starts_with('#')).map(String::from).collect()
    };
    blocks.iter().filter(|block| !is_shown(block)).flat_map(of_block).collect()
}

/// The command that this one means on a machine that has the program, in a shell.
fn shell(folder: &Path, command: &str) -> Command {
    let programs = Path::new(env!("CARGO_BIN_EXE_surfaced")).parent().unwrap();
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
    let mut shell = Command::new("sh");
    let command = command.replace("cargo run --release --", "surfaced");
    shell.args(["-c", &format!("exec {command}")]).current_dir(folder);
    shell.env("PATH", path).env("HOME", folder);
    shell
}

/// Types a command, which must work and say what to do next.
#[track_caller]
fn succeeds(folder: &Path, command: &str) -> Output {
    let output = shell(folder, command).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{command}: {said}");
    let leads_on = said.contains("\nnext: ") || said.starts_with("next: ");
    let lists = command.starts_with("surfaced library list") || command.contains(" --csv");
    let leads_on = leads_on || String::from_utf8_lossy(&output.stdout).contains("next:");
    assert!(leads_on || lists, "{command} says what to do next: {said}");
    output
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

/// The recordings that the README asks for.
fn first_recordings(folder: &Path) {
    for (surface, width) in [("table", 2), ("jeans", 7)] {
        for take in 1..=5 {
            let file = folder.join(format!("my-library/{surface}/{take}.wav"));
            record(&file, 44_100, width, take + 10 * width as u32);
        }
    }
    record(&folder.join("new/1.wav"), 44_100, 7, 99);
    // A scan as a station keeps it: the answer that the page of the interface shows.
    let page = blocks(include_str!("../../src/serve/README.md")).join("\n\n");
    let rest = page.split_once("$ curl http://127.0.0.1:8080/api/v1/scans/1\n").unwrap().1;
    let answer = rest.split("\n\n").next().unwrap();
    let answer: serde_json::Value = serde_json::from_str(answer).unwrap();
    let line = format!("{{\"answer\":{answer}}}\n");
    write_file(&folder.join("my-library/.history/answers.jsonl"), line);
}

#[test]
fn every_command_of_the_pages_works_or_says_why_it_is_not_run() {
    let folder = tempfile::tempdir().unwrap();
    first_recordings(folder.path());
    let mut unused: BTreeSet<&str> = ELSEWHERE.iter().map(|(begin, _)| *begin).collect();
    let mut outputs: BTreeMap<String, Output> = BTreeMap::new();
    // The README comes first: its recordings are what the other pages work on.
    for (page, text) in pages() {
        for command in commands(&text) {
            match ELSEWHERE.iter().find(|(begin, _)| format!("{command} ").starts_with(begin)) {
                Some((begin, _)) => {
                    unused.remove(begin);
                }
                None if outputs.contains_key(&command) => {}
                None => {
                    println!("{}: {command}", page.display());
                    let output = succeeds(folder.path(), &command);
                    outputs.insert(command, output);
                }
            }
        }
    }
    assert!(unused.is_empty(), "no page shows these any more: {unused:?}");
    let shown = |command: &str| String::from_utf8_lossy(&outputs[command].stdout).into_owned();
    let eval = shown("surfaced eval my-library");
    assert!(eval.contains("accuracy   100.0 % (10 of 10"), "{eval}");
    let replay = shown("surfaced replay new --library my-library");
    assert!(replay.contains("1/1  jeans"), "{replay}");
    let list = shown("surfaced library list my-library");
    assert_eq!(list.matches("right").count(), 10, "{list}");
    let scans = std::fs::read_to_string(folder.path().join("scans.csv")).unwrap();
    assert!(scans.lines().count() == 2 && scans.contains("oak"), "{scans}");
    for written in ["plan.toml", "chart.svg", "chart.json", "duration.svg"] {
        assert!(folder.path().join(written).exists(), "{written}");
    }
    assert!(outputs.len() >= 11, "{:?}", outputs.keys());
}

#[test]
fn the_page_that_the_readme_promises_opens() {
    let folder = tempfile::tempdir().unwrap();
    let all = commands(include_str!("../../README.md"));
    let command = all.iter().find(|command| command.contains("--serve")).unwrap();
    // Another port, since that of the README may be taken here.
    let command = command.replace("--serve", "--serve=127.0.0.1:0");
    let mut station = shell(folder.path(), &command).stderr(Stdio::piped()).spawn().unwrap();
    let mut said = BufReader::new(station.stderr.take().unwrap()).lines().map(Result::unwrap);
    let address = said.find_map(|line| Some(line.strip_prefix("http://")?.parse().unwrap()));
    let reply = Client(address.expect("the address of the page")).get("/");
    assert!(reply.status == 200 && reply.body.contains("<html"), "{reply:?}");
    let id = station.id().to_string();
    assert!(Command::new("kill").args(["-s", "TERM", &id]).status().unwrap().success());
    drop(said);
    station.wait().unwrap();
}

#[test]
fn lmt108_as_a_newcomer_has_it_is_evaluated_without_options() {
    let Some(data) = common::shared_lmt108() else { return };
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path().join("LMT_108_SurfaceMaterials_Database");
    std::os::unix::fs::symlink(data, here).unwrap();
    let all = commands(include_str!("../../README.md"));
    let eval = all.iter().find(|command| command.starts_with("surfaced eval LMT_108")).unwrap();
    let shown = String::from_utf8(succeeds(folder.path(), eval).stdout).unwrap();
    assert!(shown.contains("leave-one-trial-out · embedding · mi2"), "{shown}");
}

#[test]
fn files_of_the_pages_are_read() {
    let (mut libraries, mut trials, mut stations) = (0, 0, 0);
    for block in blocks(include_str!("../../src/method/library/README.md")) {
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
    let mut outputs = 0;
    let tables = include_str!("../../configs/README.md").to_string();
    for block in blocks(&(tables + include_str!("../../src/outputs/README.md"))) {
        if block.starts_with("format = 1") {
            StationConfig::parse(&block, Path::new("station.toml")).unwrap();
            stations += 1;
        }
        if block.starts_with("[outputs]") || block.starts_with("[[alert]]") {
            let file = format!("format = 1\n{block}");
            StationConfig::parse(&file, Path::new("station.toml")).unwrap();
            outputs += 1;
        }
    }
    assert_eq!((libraries, trials, stations, outputs), (1, 1, 1, 2));
}

#[test]
fn links_and_files_of_the_pages_and_workflows_are_there() {
    let pages = pages();
    assert!(pages.len() >= 10, "{}", pages.len());
    for (page, text) in &pages {
        let folder = root().join(page).parent().unwrap().to_path_buf();
        for link in links(text) {
            assert!(folder.join(link).exists(), "{} links to {link}", page.display());
        }
        // Code within lines: `tools/cross-users LIBRARY…`.
        for code in text.split('`').skip(1).step_by(2) {
            exists(code.split_whitespace().next().unwrap_or_default(), page);
        }
    }
    for workflow in std::fs::read_dir(root().join(".github/workflows")).unwrap() {
        let path = workflow.unwrap().path();
        let text = std::fs::read_to_string(&path).unwrap();
        let words = text.split(|c: char| c.is_whitespace() || "\"'()$".contains(c));
        words.for_each(|word| exists(word, &path));
    }
    let version = env!("CARGO_PKG_VERSION");
    let readme = include_str!("../../README.md");
    for file in [format!("surfaced_{version}-1_amd64.deb"), format!("surfaced-v{version}-x86_64")] {
        assert!(readme.contains(&file), "the README names {file}");
    }
    let citation = include_str!("../../CITATION.cff");
    assert!(citation.contains(&format!("\nversion: {version}\n")), "what is cited is this version");
}

/// Holds that a word which looks like a file of the repository is one.
#[track_caller]
fn exists(word: &str, page: &Path) {
    let begins = ["tools/", ".ci/", ".github/", "configs/", "tests/", "src/", "firmware/"];
    let is_path = begins.iter().any(|begin| word.starts_with(begin));
    // Built there, or one of several.
    if is_path && !word.contains("/target/") && !word.contains(['*', '…']) {
        assert!(root().join(word).exists(), "{} names {word}", page.display());
    }
}

#[test]
fn the_embedded_scene_explains_itself() {
    let folder = tempfile::tempdir().unwrap();
    let all = commands(include_str!("../../README.md"));
    let output = succeeds(folder.path(), &all[0]);
    let said = String::from_utf8_lossy(&output.stderr);
    let shown = String::from_utf8_lossy(&output.stdout);
    for part in ["are almost alike", "is not in the library", "the accelerometer is dead"] {
        assert!(said.contains(part), "`{part}` is not in: {said}");
    }
    for part in ["accuracy ", "unknown  ", "of new surfaces", "left out ac in 1 scan"] {
        assert!(shown.contains(part), "`{part}` is not in: {shown}");
    }
    assert!(said.contains("ac: channel"), "the dead sensor is said: {said}");
}
