//! The microphone: the monitor of a real sound server, which stalls, dies and comes back.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use surfaced::trial::Signal;

use crate::daemon::Daemon;
use crate::dice::Dice;
use crate::disk::Disk;
use crate::round::account;
use crate::sound_server::{SINK, Server};
use crate::{Failure, Samples};

/// Samples a second.
const RATE_HZ: f64 = 44_100.0;
/// Sound in buffers, and the time that a stream may be silent before its state says so, in seconds.
const SLACK_S: f64 = 1.5;
/// The most by which a stream may seem to give more than the time since its opening, in seconds: delays
/// that are no losses, and the clock of another process.
const AHEAD_S: f64 = 0.5;
/// Length of what is played, in seconds: longer than a station lives.
const PLAYED_S: usize = 120;

/// A sound server that plays dragging sounds into its own microphone.
pub struct Sound {
    server: Server,
    wav: PathBuf,
    player: Option<Child>,
    state: State,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    Works,
    Stalled,
    Dead,
}

impl Sound {
    /// None where the program takes no microphone or there is no sound server, which it says.
    ///
    /// # Panics
    /// In that case, if `SURFACED_REQUIRE_SOUND=1`.
    pub fn start(program: &str, dir: &Path, disk: &Disk) -> Result<Option<Self>, Failure> {
        if !has_microphones(program)? {
            crate::sound_server::is_missing("a PROGRAM that was built with `--features live`");
            return Ok(None);
        }
        let Some(server) = Server::start() else { return Ok(None) };
        let wav = dir.join("drags.wav");
        write(&wav, disk)?;
        Ok(Some(Self { server, wav, player: None, state: State::Works }))
    }

    /// Makes it the program's microphone.
    pub fn configure(&self, command: &mut Command) {
        command.env("ALSA_CONFIG_PATH", self.server.alsa());
    }

    /// Plays from the beginning, also after whatever has befallen it.
    pub fn play(&mut self) -> Result<(), Failure> {
        self.recover()?;
        self.hush();
        let mut player = self.server.client("paplay");
        player.args(["-d", SINK]).arg(&self.wav).stdout(Stdio::null()).stderr(Stdio::null());
        self.player = Some(player.spawn()?);
        Ok(())
    }

    fn hush(&mut self) {
        if let Some(mut player) = self.player.take() {
            let _ = player.kill();
            let _ = player.wait();
        }
    }

    /// Does not answer for a while.
    pub fn stall(&mut self) {
        if self.state == State::Works {
            self.server.signal("STOP");
            self.state = State::Stalled;
        }
    }

    pub fn die(&mut self) {
        self.server.kill();
        self.state = State::Dead;
    }

    /// It may work again by now.
    pub fn perhaps_recover(&mut self, dice: &mut Dice) -> Result<(), Failure> {
        match self.state {
            State::Works => Ok(()),
            _ if dice.once_in(2) => Ok(()),
            State::Stalled => self.recover(),
            State::Dead => self.play(),
        }
    }

    fn recover(&mut self) -> Result<(), Failure> {
        match self.state {
            State::Works => {}
            State::Stalled => self.server.signal("CONT"),
            State::Dead => self.server.restart(),
        }
        self.state = State::Works;
        Ok(())
    }

    /// The account of the samples of a station's microphone until `ended`, as far as the station's
    /// own words show it; and the most that there can have been: a stream that is opened may hold
    /// sound back until its server works.
    pub fn account(
        &self,
        daemon: &Daemon,
        ended: Instant,
        said: &str,
    ) -> Result<(Samples, u64), Failure> {
        let (received, lost) = account(said, "sound").ok_or("it gave no account of sound")?;
        let states = daemon.states("microphone");
        let streams = |(_, state): &(Instant, String)| state == "streaming";
        let since = states.iter().find(|state| streams(state)).map_or(ended, |(since, _)| *since);
        // Missing sound is counted once sound arrives again.
        let last = states.iter().rposition(streams);
        let silent = last.and_then(|at| states.get(at + 1)).map_or(ended, |(since, _)| *since);
        let samples =
            |from: Instant| (ended.saturating_duration_since(from).as_secs_f64() * RATE_HZ) as u64;
        let unknowable = samples(silent) + (SLACK_S * RATE_HZ) as u64;
        let opened = states.first().map_or(ended, |(since, _)| *since);
        // It goes on until the station has ended, which is by now.
        let most = ((opened.elapsed().as_secs_f64() + AHEAD_S) * RATE_HZ) as u64;
        Ok((Samples { sent: samples(since), received, lost, unknowable }, most))
    }
}

impl Drop for Sound {
    fn drop(&mut self) {
        self.hush();
    }
}

/// Whether a program was built with the drivers of microphones.
fn has_microphones(program: &str) -> Result<bool, Failure> {
    let output = Command::new(program).args(["devices", "--json"]).output()?;
    let devices: serde_json::Value = serde_json::from_slice(&output.stdout)?;
    Ok(devices["microphones"]["built"] == true)
}

/// The sounds of drags over each surface, again and again.
fn write(path: &Path, disk: &Disk) -> Result<(), Failure> {
    let spec = hound::WavSpec {
        channels: 1,
        sample_rate: RATE_HZ as u32,
        bits_per_sample: 16,
        sample_format: hound::SampleFormat::Int,
    };
    let mut samples = Vec::new();
    for entry in disk.data.entries.iter().filter(|entry| entry.key.number == 4) {
        if let Some(Signal::Series(sound)) = entry.load()?.signals.get("mi2") {
            samples.extend(sound.samples().iter().map(|x| (x * 32_767.0) as i16));
        }
    }
    let mut writer = hound::WavWriter::create(path, spec)?;
    for sample in samples.iter().cycle().take(PLAYED_S * RATE_HZ as usize) {
        writer.write_sample(*sample)?;
    }
    Ok(writer.finalize()?)
}
