//! Runs one station from start to end, and checks what it left.

use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::Command;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use crate::daemon::Daemon;
use crate::dice::Dice;
use crate::disk::Disk;
use crate::line::{Line, Tape};
use crate::sound::Sound;
use crate::{Failure, Samples, Sums, page};

/// The longest time that the end of a station may take.
const END: Duration = Duration::from_secs(5);
/// The most memory that a station may use, in MB.
const MOST_MB: u64 = 600;
/// Most samples that may come after the station has stopped reading, if it ends in mid-stream.
const UNDER_WAY: u64 = 4000;
/// Most readers that ask for all events and read none.
const STALLED: usize = 4;

/// Faults outside the line; every sample must be accounted for after such a fault.
const GENTLE: [&str; 9] = [
    "line stalls",
    "orders race",
    "orders race",
    "disk fills",
    "disk empties",
    "library is edited",
    "reader stalls",
    "lines of JSON are not read",
    "samples are lost",
];
/// Faults of the stylus's line.
const ROUGH: [&str; 4] = ["garbage", "hellos", "unplugged", "restarted"];
/// Faults of the sound server.
const LOUD: [&str; 2] = ["sound server stalls", "sound server dies"];

/// All that a station needs to run.
pub struct Round<'a> {
    pub program: &'a str,
    pub dir: &'a Path,
    pub disk: &'a Disk,
    pub tape: &'a Tape,
    pub sound: Option<&'a mut Sound>,
}

/// A running station, and the things that attack it.
struct Life<'a> {
    disk: &'a Disk,
    daemon: Daemon,
    address: SocketAddr,
    line: Line<'a>,
    sound: Option<&'a mut Sound>,
    dice: Dice,
    stalled: Vec<TcpStream>,
}

impl Round<'_> {
    fn command(&self, dice: &mut Dice) -> Result<Command, Failure> {
        let config = self.dir.join("station.toml");
        let text = format!(
            "format = 1\n[microphone]\npresent = {}\n[camera]\npresent = false\n[enroll]\n\
             t_star = []\n",
            self.sound.is_some()
        );
        std::fs::write(&config, text)?;
        let mut command = Command::new(self.program);
        if let Some(sound) = &self.sound {
            sound.configure(&mut command);
        }
        match dice.below(3) {
            0 => command.args(["record", "--label", "felt"]),
            1 => command.args(["run", "--method", "reference"]),
            _ => command.arg("run"),
        };
        command.args(["--serve=127.0.0.1:0", "--json", "--library"]).arg(self.disk.library());
        command.arg("--config").arg(config).arg("--stylus").arg(self.dir.join("stylus"));
        Ok(command)
    }

    /// Lets a station work during attacks, ends the station, and checks what it left.
    pub fn run(mut self, seed: u64, sums: &mut Sums) -> Result<(), Failure> {
        let mut dice = Dice(seed);
        self.disk.empty()?;
        self.sound.as_mut().map_or(Ok(()), |sound| sound.play())?;
        let line = Line::new(self.dir, self.tape);
        let mut daemon = Daemon::start(&mut self.command(&mut dice)?)?;
        let address = daemon.address()?;
        let highest = page::watch(address)?;
        let Self { disk, sound, .. } = self;
        let mut life = Life { disk, daemon, address, line, sound, dice, stalled: Vec::new() };
        life.suffer(sums)?;
        let killed = life.dice.once_in(4);
        life.end(killed, sums)?;
        let lines = life.daemon.lines();
        let scans = life.daemon.scans();
        sums.scans += scans.len() as u64;
        // A station that was killed need not have reported its last scans.
        let seen = if killed { 0 } else { highest.load(Ordering::Relaxed) };
        let silent: Vec<u64> = (1..=seen).filter(|scan| !scans.contains(scan)).collect();
        if !silent.is_empty() {
            let said = life.daemon.said();
            sums.violations.push(format!("nothing was said of scans {silent:?}: {said} {lines:?}"));
        }
        disk.empty()?;
        let (kept, wrong) = disk.check(&lines)?;
        sums.kept += kept;
        sums.violations.extend(wrong);
        Ok(())
    }
}

impl Life<'_> {
    /// Lets the station work, and attacks it now and then.
    fn suffer(&mut self, sums: &mut Sums) -> Result<(), Failure> {
        // In one life of four, the line itself has no faults.
        let gentle = self.dice.once_in(4);
        let rough: &[&str] = if gentle { &[] } else { &ROUGH };
        let loud: &[&str] = if self.sound.is_some() { &LOUD } else { &[] };
        let faults = [&GENTLE[..], loud, rough].concat();
        sums.story.clear();
        for _ in 0..8 + self.dice.below(8) {
            if !self.line.is_started() {
                let said = self.daemon.said();
                return Err(format!("the stylus is not started; {said}").into());
            }
            self.line.serve(self.dice.between(0.1, 1.2));
            if let Some(sound) = &mut self.sound {
                sound.perhaps_recover(&mut self.dice)?;
            }
            let fault = *self.dice.pick(&faults);
            *sums.faults.entry(fault).or_default() += 1;
            sums.story.push((fault, self.line.sent()));
            self.strike(fault)?;
            if !self.daemon.is_alive() {
                let said = self.daemon.said();
                return Err(format!("it ended by itself after {fault}: {said}").into());
            }
            if let Err(error) = page::request(self.address, "GET", "/healthz", "") {
                sums.violations.push(format!("after {fault}: no answer: {error}"));
            }
        }
        Ok(())
    }

    fn strike(&mut self, fault: &str) -> Result<(), Failure> {
        let Self { disk, daemon, address, line, sound, dice, stalled } = self;
        match fault {
            "line stalls" => line.stall(dice),
            "orders race" => page::order(*address, &disk.data.surfaces(), dice),
            "disk fills" => disk.empty().and_then(|()| disk.fill())?,
            "disk empties" => disk.empty()?,
            // The edit fails if the disk is full or the library is moved away, which is no fault.
            "library is edited" => drop(disk.edit(dice)),
            "reader stalls" if stalled.len() < STALLED => stalled.push(page::stalled(*address)?),
            "lines of JSON are not read" => {
                daemon.stalled.fetch_xor(true, Ordering::Relaxed);
            }
            "samples are lost" => line.lose(dice),
            "garbage" => line.garbage(dice),
            "hellos" => line.hellos(dice),
            "unplugged" => line.replug(dice),
            "restarted" => line.restart(),
            "sound server stalls" => sound.iter_mut().for_each(|sound| sound.stall()),
            "sound server dies" => sound.iter_mut().for_each(|sound| sound.die()),
            _ => {}
        }
        Ok(())
    }

    /// Ends or kills the station, and checks its end and its counts of samples.
    fn end(&mut self, killed: bool, sums: &mut Sums) -> Result<(), Failure> {
        let peak_mb = self.daemon.peak_mb().unwrap_or(0);
        sums.peak_mb = sums.peak_mb.max(peak_mb);
        if peak_mb > MOST_MB {
            sums.violations.push(format!("it had {peak_mb} MB"));
        }
        let signal = if killed { "KILL" } else { "TERM" };
        *sums.faults.entry(signal).or_default() += 1;
        let line = &mut self.line;
        // In one case of four, the line is quiet before the end; else samples are on their way.
        let quiet = self.dice.once_in(4);
        let begin = Instant::now();
        while quiet && begin.elapsed() < Duration::from_millis(800) {
            line.obey();
        }
        let struck = Instant::now();
        let (status, took) = self.daemon.end(signal, || line.obey())?;
        let sent = line.sent();
        if killed {
            sums.stylus.add(&Samples { sent, unknowable: sent, ..Samples::default() });
            return Ok(());
        }
        let said = self.daemon.said();
        if took > END {
            sums.violations.push(format!("the end took {took:?}: {said}"));
        }
        if !matches!(status.code(), Some(0 | 1 | 3)) || said.contains("panicked") {
            sums.violations.push(format!("it ended with {status}: {said}"));
        }
        let (received, lost) = account(&said, "ir").ok_or(format!("it gave no account: {said}"))?;
        let under_way = if quiet { 0 } else { UNDER_WAY };
        let unknowable = line.unknowable + line.lost_at_the_end() + under_way;
        let samples = Samples { sent, received, lost, unknowable };
        // A line without faults must not report losses that did not happen.
        let invented = line.unknowable == 0 && received + lost > sent;
        if !sums.stylus.add(&samples) || received > sent || invented {
            sums.violations.push(format!("the stylus's {}: {said}", samples.json("samples")));
        }
        let Some(sound) = &self.sound else { return Ok(()) };
        let (samples, most) = sound.account(&self.daemon, struck, &said)?;
        let invented = samples.received + samples.lost > most;
        if !sums.sound.add(&samples) || invented {
            sums.violations.push(format!("the sound's {}: {said}", samples.json("samples")));
        }
        Ok(())
    }
}

/// Reads the received and the lost samples of a stream from "received: ac 10 (0 lost), …".
pub fn account(said: &str, stream: &str) -> Option<(u64, u64)> {
    let account = said.lines().rev().find_map(|line| line.strip_prefix("received: "))?;
    let mut words = account.split(&format!("{stream} ")).nth(1)?.split(' ');
    let mut number = || words.next()?.trim_start_matches('(').parse().ok();
    Some((number()?, number()?))
}
