//! The disk of the library, which fills and empties, and on which other processes write.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use surfaced::dataset;
use surfaced::dataset::synth::{self, Parameters};
use surfaced::library::Library;
use surfaced::record::{TrialOptions, write_trial};
use surfaced::scene::Scene;
use surfaced::trial::TrialKey;

use crate::Failure;
use crate::dice::Dice;

/// The sources of the stylus and of the microphone.
const SOURCES: [&str; 6] = ["ac", "fr", "ir", "me", "mi1", "mi2"];
/// Size of the disk, which past scans fill within some 20 minutes.
const SIZE: &str = "size=32m";

/// A small disk in memory. If none may be mounted, a folder instead, whose library is moved away to
/// act as a full disk.
pub struct Disk {
    folder: PathBuf,
    mounted: bool,
    /// The trials of each surface; trial number 4 is not in the library.
    pub data: Library,
}

impl Disk {
    pub fn new(dir: &Path) -> Result<Self, Failure> {
        let folder = dir.join("disk");
        fs::create_dir(&folder)?;
        let mount = Command::new("mount")
            .args(["-t", "tmpfs", "-o", SIZE, "none"])
            .arg(&folder)
            .stderr(std::process::Stdio::null())
            .status();
        let mounted = mount.is_ok_and(|status| status.success());
        if !mounted {
            eprintln!("no disk can be mounted: instead of filling up, the library goes away");
        }
        let parameters = Parameters {
            surfaces: 3,
            trials: 4,
            users: 0,
            drag_seconds: 1.0,
            ..Parameters::default()
        };
        let disk = Self { folder, mounted, data: synth::library(&parameters) };
        for surface in disk.data.surfaces() {
            (1..=3).try_for_each(|number| disk.write(surface, number))?;
        }
        Ok(disk)
    }

    pub fn library(&self) -> PathBuf {
        self.folder.join("library")
    }

    fn write(&self, surface: &str, number: u32) -> Result<(), Failure> {
        let key = TrialKey::new(surface, surfaced::trial::EXPERT, number);
        let entry = self.data.entries.iter().find(|entry| entry.key == key).ok_or("no trial")?;
        let mut trial = entry.load()?;
        trial.signals.retain(|id, _| SOURCES.contains(&id.as_str()));
        let options = TrialOptions { durable: false, ..TrialOptions::default() };
        write_trial(&self.library(), &trial, &self.data.scene, &options)?;
        Ok(())
    }

    /// Fills the disk, so that it takes no more bytes until [`Self::empty`].
    pub fn fill(&self) -> Result<(), Failure> {
        if !self.mounted {
            fs::rename(self.library(), self.folder.join("moved"))?;
            fs::write(self.library(), "")?;
            return Ok(());
        }
        let mut filler = fs::File::create(self.folder.join("filler"))?;
        for size in [1 << 16, 1 << 12, 1] {
            while filler.write_all(&vec![0; size]).is_ok() {}
        }
        Ok(())
    }

    pub fn empty(&self) -> Result<(), Failure> {
        let moved = self.folder.join("moved");
        if moved.exists() {
            fs::remove_file(self.library())?;
            fs::rename(moved, self.library())?;
        } else if self.mounted {
            let _ = fs::remove_file(self.folder.join("filler"));
        }
        Ok(())
    }

    /// Edits the library at random, as another process would. Fails if the disk is full.
    pub fn edit(&self, dice: &mut Dice) -> Result<(), Failure> {
        let surface = self.library().join(dice.pick(&self.data.surfaces()));
        let strange = surface.join(format!("trial{}", 50 + dice.below(5)));
        match dice.below(5) {
            // Trials come and go, even under numbers that a recorder is about to use.
            0 | 1 if strange.exists() => fs::remove_dir_all(strange)?,
            0 | 1 => {
                fs::create_dir(&strange)?;
                fs::copy(surface.join("expert-01/ir.wav"), strange.join("ir.wav"))?;
            }
            2 => {
                let trial = surface.join("expert-03");
                if trial.exists() {
                    fs::remove_dir_all(trial)?;
                } else {
                    self.write(surface.file_name().and_then(|n| n.to_str()).ok_or("name")?, 3)?;
                }
            }
            3 => fs::write(surface.join("notes.txt"), dice.bytes(100))?,
            _ => {
                let link = surface.join("gone");
                if link.is_symlink() {
                    fs::remove_file(link)?;
                } else {
                    std::os::unix::fs::symlink("nowhere", link)?;
                }
            }
        }
        Ok(())
    }

    /// Checks the trials that lines of JSON report as kept, and removes them, so that the library
    /// stays small. Returns the number of these trials, and a text for each problem.
    pub fn check(&self, lines: &[Value]) -> Result<(u64, Vec<String>), Failure> {
        let opened = dataset::open_usable(&self.library(), &Scene::lmt108())?;
        let mut wrong: Vec<String> = Vec::new();
        let kept: Vec<&Value> = lines.iter().filter(|line| line["outcome"] == "kept").collect();
        for line in &kept {
            let of = |key: &str| line[key].as_str().unwrap_or_default();
            let number = line["trial"].as_u64().unwrap_or_default() as u32;
            let session = line["session"].as_str().map(String::from);
            let key = TrialKey::new(of("surface"), of("user"), number).with_session(session);
            let folder = Path::new(of("folder"));
            let entry = opened.library.entries.iter().find(|entry| entry.key == key);
            match entry.map(|entry| entry.load()) {
                Some(Ok(trial)) if !trial.signals.is_empty() => {}
                Some(Ok(_)) => wrong.push(format!("{} holds nothing", folder.display())),
                Some(Err(error)) => wrong.push(error.to_string()),
                // A trial with gaps is kept on disk, but readers of the library skip it.
                None if !line["remarks"].as_array().is_none_or(Vec::is_empty)
                    && folder.join("trial.toml").is_file()
                    && SOURCES.iter().any(|id| folder.join(format!("{id}.wav")).is_file()) => {}
                None => {
                    let bad: Vec<_> = opened.bad.iter().map(ToString::to_string).collect();
                    wrong.push(format!("{} is not there: {line} {bad:?}", folder.display()));
                }
            }
        }
        for line in &kept {
            let _ = fs::remove_dir_all(line["folder"].as_str().unwrap_or_default());
        }
        Ok((kept.len() as u64, wrong))
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        if self.mounted {
            let _ = Command::new("umount").arg("-l").arg(&self.folder).status();
        }
    }
}
