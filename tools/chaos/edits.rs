//! Two processes edit a library, and are killed in the middle, while a third records into it and a
//! fourth reviews past scans. Afterwards every trial must be there once and whole, and undoing all
//! steps must restore the first state.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use surfaced::history::{History, Keeper};
use surfaced::library::About;
use surfaced::record::{TrialOptions, append_trial};
use surfaced::scan::Scan;
use surfaced::scene::{Scene, SourceId};
use surfaced::serve::LibraryFolder;
use surfaced::station::{Answer, AnsweredScan, Listener, StationEvent};
use surfaced::trial::{Series, Signal, Trial, TrialKey};

use crate::dice::Dice;
use crate::http::{Served, answer, serve};
use crate::{Failure, Sums};

/// How long all processes work on the library.
const LENGTH: Duration = Duration::from_secs(8);
/// Names of surfaces. One of them is also the name of a file in a library.
const SURFACES: [&str; 4] = ["oak", "ash", "elm", "library.toml"];
/// Number of samples in a recording, and number of bytes before the samples in its file.
const SAMPLES: usize = 500;
const HEADER: usize = 44;
/// Number of past scans that are reviewed.
const SCANS: u32 = 6;

/// The library that all processes edit.
struct Edited<'a> {
    program: &'a str,
    root: PathBuf,
    scene: Scene,
    ended: AtomicBool,
    /// Number of the next recording, which is the first sample of the recording.
    next: AtomicU64,
    /// The label of each recorded trial, by the number of the recording.
    recorded: Mutex<BTreeMap<u16, String>>,
    edits: AtomicU64,
    kills: AtomicU64,
}

/// Lets all processes work on a library for a while, and then checks the library.
pub fn round(program: &str, dir: &Path, seed: u64, sums: &mut Sums) -> Result<(), Failure> {
    let root = dir.join(format!("edited-{seed}"));
    let edited = Edited {
        program,
        root: root.clone(),
        scene: Scene::lmt108(),
        ended: AtomicBool::new(false),
        next: AtomicU64::new(1),
        recorded: Mutex::default(),
        edits: AtomicU64::new(0),
        kills: AtomicU64::new(0),
    };
    for surface in SURFACES {
        (0..3).try_for_each(|_| edited.record(surface))?;
    }
    let served = edited.review_scans()?;
    let mut dice = Dice(seed ^ 0x00ed_1700);
    let seeds = [(); 5].map(|()| dice.below(u64::MAX));
    std::thread::scope(|scope| {
        let edited = &edited;
        seeds[..2].iter().for_each(|&seed| drop(scope.spawn(move || edited.edit(Dice(seed)))));
        scope.spawn(move || edited.enroll(Dice(seeds[2])));
        for &seed in &seeds[3..] {
            let client = *served;
            scope.spawn(move || edited.review(client, Dice(seed)));
        }
        std::thread::sleep(LENGTH);
        edited.ended.store(true, Ordering::Relaxed);
    });
    drop(served);
    let wrong = edited.check()?;
    sums.violations.extend(wrong.into_iter().map(|wrong| format!("edits: {wrong}")));
    *sums.faults.entry("edits").or_default() += edited.edits.into_inner();
    *sums.faults.entry("edits killed").or_default() += edited.kills.into_inner();
    Ok(fs::remove_dir_all(root)?)
}

impl Edited<'_> {
    fn goes_on(&self) -> bool {
        !self.ended.load(Ordering::Relaxed)
    }

    fn signals(&self) -> Result<(u16, BTreeMap<SourceId, Signal>), Failure> {
        let number = self.next.fetch_add(1, Ordering::Relaxed) as u16;
        let samples = (0..SAMPLES).map(|i| (i as f32 + f32::from(number)) / 32768.0).collect();
        let series = Signal::Series(Series::new(10_000.0, 1, samples)?);
        Ok((number, BTreeMap::from([(SourceId::new("ir")?, series)])))
    }

    /// Adds a trial, as another process would.
    fn record(&self, surface: &str) -> Result<(), Failure> {
        let (number, signals) = self.signals()?;
        let trial = Trial { key: TrialKey::new(surface, "anna", 1), signals };
        let options = TrialOptions { durable: false, ..TrialOptions::default() };
        append_trial(&self.root, &trial, &self.scene, &options)?;
        let mut recorded = self.recorded.lock().map_err(|_| "a recorder panicked")?;
        recorded.insert(number, surface.into());
        Ok(())
    }

    fn enroll(&self, mut dice: Dice) {
        while self.goes_on() {
            std::thread::sleep(Duration::from_millis(dice.below(300)));
            // A failure is ignored: a trial that could not be written does not count.
            let _ = self.record(dice.pick::<&str>(&SURFACES));
        }
    }

    /// Edits by the command line, one process for each edit; some of the processes are killed.
    fn edit(&self, mut dice: Dice) {
        while self.goes_on() {
            let (one, what) = (*dice.pick(&SURFACES), dice.below(8));
            let other = *dice.pick(&SURFACES);
            let trial = format!("{other}/anna-0{}", 1 + dice.below(4));
            let mut command = Command::new(self.program);
            command.arg("library");
            let root = &self.root;
            match what {
                0 | 1 => command.arg("rename").arg(root).args([one, other]),
                2 => command.arg("move").arg(root).args([one, &trial, "--to", other]),
                3 => command.arg("remove").arg(root).arg(one),
                4 => command.arg("remove").arg(root).arg(trial),
                5 => command.arg("restore").arg(root).arg(one),
                _ => command.arg("undo").arg(root),
            };
            let quiet = command.stdout(Stdio::null()).stderr(Stdio::null());
            let Ok(mut child) = quiet.spawn() else { continue };
            self.edits.fetch_add(1, Ordering::Relaxed);
            if dice.once_in(2) {
                std::thread::sleep(Duration::from_micros(dice.below(60_000)));
                let _ = child.kill();
                self.kills.fetch_add(1, Ordering::Relaxed);
            }
            let _ = child.wait();
        }
    }

    /// Starts a station that has past scans, and whose users may edit the library.
    fn review_scans(&self) -> Result<Served, Failure> {
        let history = Arc::new(History::open(&self.root.join(".history"), 1 << 24)?);
        let scene = self.scene.clone();
        let mut keeper = Keeper::start(history.clone(), scene.clone(), BTreeMap::new(), None)?;
        for number in 1..=SCANS {
            let scan = Scan { scan_s: 0.05, ..Scan::of_signals(number, self.signals()?.1) };
            let answer = Arc::new(Answer { doubts: Vec::new(), ..answer(number, Some("oak")) });
            let whole = AnsweredScan { scan: Box::new(scan), answer, by: None };
            keeper.on_event(&StationEvent::Scan(Arc::new(whole)));
        }
        drop(keeper);
        let folder = self.root.clone();
        Ok(serve(|settings| {
            settings.history = history;
            settings.library = Some(LibraryFolder { folder, scene });
        }))
    }

    /// Corrects scans, keeps scans and undoes edits, as the page of a station does.
    fn review(&self, client: crate::http::Client, mut dice: Dice) {
        while self.goes_on() {
            std::thread::sleep(Duration::from_millis(dice.below(50)));
            let (scan, label) = (1 + dice.below(SCANS.into()), *dice.pick(&SURFACES));
            let (path, body) = match dice.below(6) {
                0 | 1 => (format!("scans/{scan}/correct"), format!("{{\"surface\":\"{label}\"}}")),
                2 => (format!("scans/{scan}/correct"), "{\"unknown\":true}".into()),
                3 | 4 => (format!("scans/{scan}/keep"), "{\"user\":\"bob\"}".into()),
                _ => ("library/undo".into(), String::new()),
            };
            self.edits.fetch_add(1, Ordering::Relaxed);
            client.post(&format!("/api/v1/{path}"), &body);
        }
    }

    /// The label of each trial on disk, and whether the trial is removed; adds problems to `wrong`.
    fn trials(&self, wrong: &mut Vec<String>) -> BTreeMap<u16, (String, bool)> {
        let mut found = BTreeMap::new();
        for (root, is_removed) in [(self.root.clone(), false), (self.root.join(".removed"), true)] {
            for folder in folders(&root).iter().flat_map(|surface| folders(surface)) {
                let shown = folder.display();
                let bytes = fs::read(folder.join("ir.wav")).unwrap_or_default();
                let label = About::read(&folder).ok().and_then(|about| about.surface);
                let (Some(label), true) = (label, bytes.len() == HEADER + 2 * SAMPLES) else {
                    wrong.push(format!("{shown} is not whole"));
                    continue;
                };
                let number = u16::from_le_bytes([bytes[HEADER], bytes[HEADER + 1]]);
                if found.insert(number, (label, is_removed)).is_some() {
                    wrong.push(format!("{shown} is there twice"));
                }
            }
        }
        found
    }

    fn check(&self) -> Result<Vec<String>, Failure> {
        let mut wrong = Vec::new();
        let command = |arguments: &[&str]| {
            let mut command = Command::new(self.program);
            command.args(["library", arguments[0]]).arg(&self.root).args(&arguments[1..]).output()
        };
        let listed = command(&["list", "--quick", "--json"])?;
        if !listed.status.success() {
            wrong.push(format!("the library cannot be opened: {listed:?}"));
        }
        let recorded = self.recorded.lock().map_err(|_| "a recorder panicked")?;
        let found = self.trials(&mut wrong);
        let gone = recorded.keys().filter(|number| !found.contains_key(number)).count();
        if gone > 0 {
            wrong.push(format!("{gone} trials are gone"));
        }
        loop {
            let undone = command(&["undo"])?;
            if !undone.status.success() {
                let said = String::from_utf8_lossy(&undone.stderr).into_owned();
                if !said.contains("no step to undo") {
                    wrong.push(format!("a step cannot be undone: {said}"));
                }
                break;
            }
        }
        let found = self.trials(&mut wrong);
        for (number, label) in recorded.iter() {
            let now = found.get(number);
            if now != Some(&(label.clone(), false)) {
                wrong.push(format!("a trial of {label} is {now:?} at the beginning"));
            }
        }
        for (number, (label, is_removed)) in &found {
            if !recorded.contains_key(number) && !is_removed {
                wrong.push(format!("a scan that was kept as {label} is there at the beginning"));
            }
        }
        Ok(wrong)
    }
}

fn folders(root: &Path) -> Vec<PathBuf> {
    let items = fs::read_dir(root).into_iter().flatten().flatten();
    let is_hidden =
        |path: &Path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
    items.map(|item| item.path()).filter(|path| path.is_dir() && !is_hidden(path)).collect()
}
