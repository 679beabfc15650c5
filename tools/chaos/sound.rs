//! The microphone is the monitor of a real sound server, which stalls, dies and comes back.

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

/// Number of sound samples a second.
const RATE_HZ: f64 = 44_100.0;
/// Seconds of sound in buffers, plus the time for which a silent stream still counts as streaming.
const SLACK_S: f64 = 1.5;
/// Most seconds by which a stream may seem to be ahead of the clock since its opening: by delays
/// that are no losses, and by the clock of another process.
const AHEAD_S: f64 = 0.5;
/// Length of the played sound in seconds, longer than the life of a station.
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
    /// Starts the sound server. `None`, after a message, without a server or microphone drivers.
    ///
    /// # Panics
    /// If there is no sound and `SURFACED_REQUIRE_SOUND=1`.
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

    /// Makes the sound server's monitor the microphone of the program.
    pub fn configure(&self, command: &mut Command) {
        command.env("ALSA_CONFIG_PATH", self.server.alsa());
    }

    /// Plays the sound from its beginning, and first repairs a stalled or dead server.
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

    /// Stalls the server: it does not answer until it recovers.
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

    /// Repairs the server in half of the calls, if it is stalled or dead.
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

    /// Counts the samples of a station's microphone until `ended`, as far as the station's messages
    /// show them. Also returns the most samples that can have come: a stream may hold back sound
    /// from the time of its opening until its server works.
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
        // The station counts missing sound only once sound arrives again.
        let last = states.iter().rposition(streams);
        let silent = last.and_then(|at| states.get(at + 1)).map_or(ended, |(since, _)| *since);
        let samples =
            |from: Instant| (ended.saturating_duration_since(from).as_secs_f64() * RATE_HZ) as u64;
        let unknowable = samples(silent) + (SLACK_S * RATE_HZ) as u64;
        let opened = states.first().map_or(ended, |(since, _)| *since);
        // The stream goes on until the station has ended, which is by now.
        let most = ((opened.elapsed().as_secs_f64() + AHEAD_S) * RATE_HZ) as u64;
        Ok((Samples { sent: samples(since), received, lost, unknowable }, most))
    }
}

impl Drop for Sound {
    fn drop(&mut self) {
        self.hush();
    }
}

/// Whether the program was built with support for microphones.
fn has_microphones(program: &str) -> Result<bool, Failure> {
    let output = Command::new(program).args(["devices", "--json"]).output()?;
    let devices: serde_json::Value = serde_json::from_slice(&output.stdout)?;
    Ok(devices["microphones"]["built"] == true)
}

/// Writes a file with the sounds of drags over each surface, again and again.
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
