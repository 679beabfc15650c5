//! A sound server to test with: PulseAudio with a null sink, whose monitor is the microphone behind
//! ALSA's pulse plugin.
//!
//! Needs the programs `pulseaudio`, `pactl` and `paplay`, and ALSA's pulse plugin (Debian:
//! pulseaudio pulseaudio-utils libasound2-plugins); where they are absent a test is skipped, unless
//! `SURFACED_REQUIRE_SOUND=1`.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::http::SOON;

/// The null sink.
pub const SINK: &str = "drag";

/// A sound server of our own, with one null sink, that ends when it is dropped.
pub struct Server {
    child: Child,
    dir: tempfile::TempDir,
}

impl Drop for Server {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Says that there is no microphone to test with; true.
///
/// # Panics
/// If `SURFACED_REQUIRE_SOUND=1`.
pub fn is_missing(what: &str) -> bool {
    let required = std::env::var("SURFACED_REQUIRE_SOUND").is_ok_and(|value| value == "1");
    assert!(!required, "{what} is absent, but SURFACED_REQUIRE_SOUND=1");
    let _ = writeln!(std::io::stderr(), "SKIPPED: the microphone, since {what} is absent");
    true
}

fn has(program: &str) -> bool {
    let run = Command::new(program).arg("--version").stdout(Stdio::null()).status();
    run.is_ok_and(|status| status.success())
}

impl Server {
    /// Starts it; none where there is no PulseAudio, unless it is required.
    pub fn start() -> Option<Self> {
        for program in ["pulseaudio", "pactl", "paplay"] {
            if !has(program) && is_missing(program) {
                return None;
            }
        }
        let dir = tempfile::tempdir().unwrap();
        for name in ["run", "home"] {
            std::fs::create_dir(dir.path().join(name)).unwrap();
        }
        let server = Self { child: launch(dir.path()), dir };
        server.wait_until_ready();
        Some(server)
    }

    fn wait_until_ready(&self) {
        let begin = Instant::now();
        while !self.client("pactl").arg("info").output().unwrap().status.success() {
            let log = || std::fs::read_to_string(self.dir.path().join("log")).unwrap();
            assert!(begin.elapsed() < SOON, "no sound server: {}", log());
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Sends it a signal by its name.
    pub fn signal(&self, name: &str) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args(["-s", name, &id]).status().unwrap().success());
    }

    /// Ends it without a warning to anybody.
    pub fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Starts it again, in the same place, once it was killed.
    pub fn restart(&mut self) {
        self.child = launch(self.dir.path());
        self.wait_until_ready();
    }

    /// A program that talks to this server.
    pub fn client(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command
            .env("PULSE_SERVER", format!("unix:{}", self.dir.path().join("socket").display()))
            .env("HOME", self.dir.path().join("home"))
            .env("XDG_RUNTIME_DIR", self.dir.path().join("run"));
        command
    }

    /// An ALSA configuration in which `default` is the monitor of the null sink.
    pub fn alsa(&self) -> PathBuf {
        let path = self.dir.path().join("asound.conf");
        let server = format!("unix:{}", self.dir.path().join("socket").display());
        let text = format!(
            "</usr/share/alsa/alsa.conf>\n\
             pcm.!default {{ type pulse server \"{server}\" device \"drag.monitor\" }}\n\
             ctl.!default {{ type pulse server \"{server}\" }}\n"
        );
        std::fs::write(&path, text).unwrap();
        path
    }
}

fn launch(dir: &Path) -> Child {
    let log = std::fs::File::create(dir.join("log")).unwrap();
    let socket = dir.join("socket");
    let _ = std::fs::remove_file(&socket);
    let native =
        format!("module-native-protocol-unix auth-anonymous=1 socket={}", socket.to_str().unwrap());
    let null = "module-null-sink sink_name=drag rate=44100 channels=1 format=s16le";
    Command::new("pulseaudio")
        .args(["-n", "--daemonize=no", "--use-pid-file=no", "--exit-idle-time=-1"])
        .args(["--disallow-exit=no", "--realtime=no", "--high-priority=no", "-L", &native])
        .args(["-L", null])
        .env("XDG_RUNTIME_DIR", dir.join("run"))
        .env("HOME", dir.join("home"))
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .unwrap()
}
