//! The life of one station, and what must hold after its end.

use std::path::Path;
use std::process::Command;
use std::sync::atomic::Ordering;
use std::time::Duration;

use crate::daemon::Daemon;
use crate::dice::Dice;
use crate::disk::Disk;
use crate::line::{Line, Tape};
use crate::{Failure, Sums, page};

/// An end takes no longer than this.
const END: Duration = Duration::from_secs(5);
/// The most memory of a station, in MB.
const MOST_MB: u64 = 600;

/// What a station needs.
pub struct Round<'a> {
    pub program: &'a str,
    pub dir: &'a Path,
    pub disk: &'a Disk,
    pub tape: &'a Tape,
}

impl Round<'_> {
    fn command(&self, dice: &mut Dice) -> Result<Command, Failure> {
        let config = self.dir.join("station.toml");
        let alone = "format = 1\n[microphone]\npresent = false\n[camera]\npresent = false\n\
                     [enroll]\nt_star = []\n";
        std::fs::write(&config, alone)?;
        let mut command = Command::new(self.program);
        match dice.below(3) {
            0 => command.args(["record", "--label", "felt"]),
            1 => command.args(["run", "--method", "reference"]),
            _ => command.arg("run"),
        };
        command.args(["--serve=127.0.0.1:0", "--json", "--library"]).arg(self.disk.library());
        command.arg("--config").arg(config).arg("--stylus").arg(self.dir.join("stylus"));
        Ok(command)
    }

    /// Lets a station work among faults, ends it, and checks what it left.
    pub fn run(&self, seed: u64, sums: &mut Sums) -> Result<(), Failure> {
        let mut dice = Dice(seed);
        self.disk.empty()?;
        let mut line = Line::new(self.dir, self.tape);
        let mut daemon = Daemon::start(&mut self.command(&mut dice)?)?;
        let address = daemon.address()?;
        let highest = page::watch(address)?;
        let (mut stalled, surfaces) = (Vec::new(), self.disk.data.surfaces());
        // In one life of four nothing is lost by the line, and every sample is accounted for.
        let gentle = dice.once_in(4);
        for _ in 0..8 + dice.below(8) {
            if !line.is_started() {
                return Err(format!("the stylus is not started; {}", daemon.said()).into());
            }
            line.serve(dice.between(0.1, 1.2));
            let fault = match dice.below(if gentle { 9 } else { 13 }) {
                0 => "line stalls",
                1 | 2 => "orders race",
                3 => "disk fills",
                4 => "disk empties",
                5 => "library is edited",
                6 => "reader stalls",
                7 => "lines of JSON are not read",
                8 => "samples are lost",
                9 => "garbage",
                10 => "hellos",
                11 => "unplugged",
                _ => "restarted",
            };
            *sums.faults.entry(fault).or_default() += 1;
            match fault {
                "line stalls" => line.stall(&mut dice),
                "orders race" => page::order(address, &surfaces, &mut dice),
                "disk fills" => self.disk.empty().and_then(|()| self.disk.fill())?,
                "disk empties" => self.disk.empty()?,
                // It fails where the disk is full, or its library gone.
                "library is edited" => drop(self.disk.edit(&mut dice)),
                "reader stalls" if stalled.len() < 4 => stalled.push(page::stalled(address)?),
                "lines of JSON are not read" => {
                    daemon.stalled.fetch_xor(true, Ordering::Relaxed);
                }
                "samples are lost" => line.lose(&mut dice),
                "garbage" => line.garbage(&mut dice),
                "hellos" => line.hellos(&mut dice),
                "unplugged" => line.replug(&mut dice),
                "restarted" => line.restart(),
                _ => {}
            }
            if !daemon.is_alive() {
                return Err(format!("it has ended by itself: {}", daemon.said()).into());
            }
            if let Err(error) = page::request(address, "GET", "/healthz", "") {
                sums.violations.push(format!("after {fault}: no answer: {error}"));
            }
        }
        self.end(&mut daemon, &mut line, &mut dice, sums)?;
        let seen = highest.load(Ordering::Relaxed);
        let lines = daemon.lines();
        let (scans, killed) = (daemon.scans(), sums.killed);
        sums.scans += scans.len() as u64;
        // Of one that was killed, the last scans may be under way.
        let silent: Vec<u64> = (1..=seen).filter(|scan| !killed && !scans.contains(scan)).collect();
        if !silent.is_empty() {
            let said = daemon.said();
            sums.violations.push(format!("nothing was said of scans {silent:?}: {said} {lines:?}"));
        }
        self.disk.empty()?;
        let (kept, wrong) = self.disk.check(&lines)?;
        sums.kept += kept;
        sums.violations.extend(wrong);
        Ok(())
    }

    /// Ends or kills a station, and checks its end and its account.
    fn end(
        &self,
        daemon: &mut Daemon,
        line: &mut Line<'_>,
        dice: &mut Dice,
        sums: &mut Sums,
    ) -> Result<(), Failure> {
        let peak_mb = daemon.peak_mb().unwrap_or(0);
        sums.peak_mb = sums.peak_mb.max(peak_mb);
        if peak_mb > MOST_MB {
            sums.violations.push(format!("it had {peak_mb} MB"));
        }
        sums.killed = dice.once_in(4);
        let signal = if sums.killed { "KILL" } else { "TERM" };
        *sums.faults.entry(signal).or_default() += 1;
        // In three of four cases in the middle of things; else with nothing under way.
        let mut under_way = 0;
        if dice.once_in(4) {
            let begin = std::time::Instant::now();
            while begin.elapsed() < Duration::from_millis(800) {
                line.obey();
            }
        } else {
            // What it sent last may come after the end of the reading.
            under_way = 4000;
        }
        let (status, took) = daemon.end(signal, || line.obey())?;
        sums.sent += line.sent();
        if sums.killed {
            sums.unknowable += line.sent();
            return Ok(());
        }
        let said = daemon.said();
        if took > END {
            sums.violations.push(format!("the end took {took:?}: {said}"));
        }
        if !matches!(status.code(), Some(0 | 1 | 3)) || said.contains("panicked") {
            sums.violations.push(format!("it ended with {status}: {said}"));
        }
        // "received: ac 10 (0 lost), …"
        let account = said.lines().rev().find_map(|line| line.strip_prefix("received: "));
        let of_ir = account.and_then(|text| text.split("ir ").nth(1));
        let number = |text: &str| text.trim_start_matches('(').parse::<u64>().ok();
        let mut words = of_ir.unwrap_or_default().split(' ').map(number);
        let (Some(Some(received)), Some(Some(lost))) = (words.next(), words.next()) else {
            return Err(format!("it gave no account: {said}").into());
        };
        let unknowable = line.unknowable + under_way;
        sums.received += received;
        sums.lost += lost;
        sums.unknowable += unknowable;
        let sent = line.sent();
        if received > sent || sent - received > lost + unknowable {
            sums.violations.push(format!(
                "{sent} samples sent, {received} received, {lost} lost, {unknowable} unknowable"
            ));
        }
        // Where the line never broke, no loss is invented either.
        if line.unknowable == 0 && received + lost > sent {
            sums.violations.push(format!("{received} received and {lost} lost of {sent}: {said}"));
        }
        Ok(())
    }
}
