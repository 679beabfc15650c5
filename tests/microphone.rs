//! The microphone's driver on a real sound server: a PulseAudio null sink, whose monitor is the
//! microphone behind ALSA's pulse plugin. A real dragging sound is played into it.
//!
//! Needs the programs `pulseaudio` and `pactl`, `paplay`, and ALSA's pulse plugin (Debian:
//! pulseaudio pulseaudio-utils libasound2-plugins); where they are absent the test is skipped,
//! unless `SURFACED_REQUIRE_SOUND=1`.
#![cfg(feature = "microphone")]

mod common;

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{id, shared};
use realfft::RealFftPlanner;
use surfaced::device::microphone::{Alsa, Microphone, RATE_HZ};
use surfaced::device::{Control, Device, DeviceState, ReportKind};
use surfaced::ring::{Bell, Piece, Sink, Stop, series};

const SOUND: &str = "data/LMT_108_SurfaceMaterials_Database/SoundScans/Movement/Training/\
                     G4CherryTree_Sound_Movement_train10.wav";
/// Silence before and after the sound, in seconds: time for the player to start, and to drain.
const MARGIN_S: f64 = 1.5;

/// A sound server of our own, with one null sink, that ends when it is dropped.
struct Server {
    child: Child,
    dir: tempfile::TempDir,
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn missing(what: &str) -> bool {
    let required = std::env::var("SURFACED_REQUIRE_SOUND").is_ok_and(|value| value == "1");
    assert!(!required, "{what} is absent, but SURFACED_REQUIRE_SOUND=1");
    let _ =
        writeln!(std::io::stderr(), "SKIPPED: a test of the microphone, since {what} is absent");
    true
}

fn has(program: &str) -> bool {
    let run = Command::new(program).arg("--version").stdout(Stdio::null()).status();
    run.is_ok_and(|status| status.success())
}

impl Server {
    /// None where there is no PulseAudio.
    fn start() -> Option<Self> {
        for program in ["pulseaudio", "pactl", "paplay"] {
            if !has(program) && missing(program) {
                return None;
            }
        }
        let dir = tempfile::tempdir().unwrap();
        let home = |name: &str| {
            let path = dir.path().join(name);
            std::fs::create_dir(&path).unwrap();
            path
        };
        let (runtime, config) = (home("run"), home("home"));
        let log = std::fs::File::create(dir.path().join("log")).unwrap();
        let socket = dir.path().join("socket");
        let native = format!(
            "module-native-protocol-unix auth-anonymous=1 socket={}",
            socket.to_str().unwrap()
        );
        let null = "module-null-sink sink_name=drag rate=44100 channels=1 format=s16le";
        let child = Command::new("pulseaudio")
            .args(["-n", "--daemonize=no", "--use-pid-file=no", "--exit-idle-time=-1"])
            .args(["--disallow-exit=no", "--realtime=no", "--high-priority=no", "-L", &native])
            .args(["-L", null])
            .env("XDG_RUNTIME_DIR", &runtime)
            .env("HOME", &config)
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .unwrap();
        let server = Self { child, dir };
        let begin = Instant::now();
        while !server.client("pactl").arg("info").output().unwrap().status.success() {
            let log = || std::fs::read_to_string(server.dir.path().join("log")).unwrap();
            assert!(begin.elapsed() < Duration::from_secs(20), "no sound server: {}", log());
            std::thread::sleep(Duration::from_millis(100));
        }
        Some(server)
    }

    fn client(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command
            .env("PULSE_SERVER", format!("unix:{}", self.dir.path().join("socket").display()))
            .env("HOME", self.dir.path().join("home"))
            .env("XDG_RUNTIME_DIR", self.dir.path().join("run"));
        command
    }

    /// An ALSA configuration in which `default` is the monitor of the null sink.
    fn alsa(&self) -> PathBuf {
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

/// The best normalised cross-correlation of `sound` with a stretch of `heard`, and where it is.
fn find(sound: &[f32], heard: &[f32]) -> (f64, usize) {
    let n = (sound.len() + heard.len()).next_power_of_two();
    let mut planner = RealFftPlanner::<f64>::new();
    let (forward, back) = (planner.plan_fft_forward(n), planner.plan_fft_inverse(n));
    let spectrum = |x: &[f32]| {
        let mut time = vec![0.0; n];
        time.iter_mut().zip(x).for_each(|(to, from)| *to = f64::from(*from));
        let mut bins = forward.make_output_vec();
        forward.process(&mut time, &mut bins).unwrap();
        bins
    };
    let mut product: Vec<_> =
        spectrum(heard).iter().zip(spectrum(sound)).map(|(h, s)| h * s.conj()).collect();
    // What rounding left there, the inverse would refuse.
    (product[0].im, product[n / 2].im) = (0.0, 0.0);
    let mut lags = back.make_output_vec();
    back.process(&mut product, &mut lags).unwrap();
    let squares = |x: &[f32]| x.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>();
    let energy = squares(sound);
    (0..=heard.len() - sound.len())
        .map(|lag| (lags[lag] / n as f64, lag))
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(sum, lag)| (sum / (energy * squares(&heard[lag..lag + sound.len()])).sqrt(), lag))
        .unwrap()
}

fn read(path: &Path) -> Vec<f32> {
    let reader = hound::WavReader::open(path).unwrap();
    assert_eq!((reader.spec().sample_rate, reader.spec().channels), (RATE_HZ, 1));
    reader.into_samples::<i16>().map(|x| f32::from(x.unwrap()) / 32_768.0).collect()
}

#[test]
fn a_real_dragging_sound_is_captured_whole_at_its_pace() {
    let Some(path) = shared(SOUND) else { return };
    let Some(server) = Server::start() else { return };
    // SAFETY: this is the only test of this binary, and no thread of it runs yet.
    unsafe { std::env::set_var("ALSA_CONFIG_PATH", server.alsa()) };
    let sound = read(&path);
    let sound_s = sound.len() as f64 / f64::from(RATE_HZ);

    let mut microphone = Microphone::new(id("mi2"), Box::new(Alsa::new("default").unwrap()));
    let (bell, woken) = Bell::new();
    let (sink, mut tap) = series(1, RATE_HZ as usize, bell);
    let (sender, reports) = crossbeam_channel::unbounded();
    let stop = Stop::default();
    let control = Control::new(0, stop.clone(), sender);
    let thread = std::thread::spawn(move || {
        let mut sinks = [Sink::Series(sink)];
        microphone.run(&mut sinks, &control)
    });

    // When the first sound was streamed, and the player that was started then.
    let mut playing: Option<(Instant, Child)> = None;
    let (mut heard, mut lost, mut warnings) = (Vec::new(), 0, Vec::new());
    let begin = Instant::now();
    let length = Duration::from_secs_f64(sound_s + 2.0 * MARGIN_S);
    while playing.as_ref().is_none_or(|(since, _)| since.elapsed() < length) {
        assert!(begin.elapsed() < Duration::from_secs(60), "the microphone never streamed");
        let _ = woken.recv_timeout(Duration::from_millis(10));
        tap.drain(|piece| match piece {
            Piece::Samples(samples) => heard.extend_from_slice(samples),
            Piece::Missing(frames) => lost += frames,
        });
        for report in reports.try_iter() {
            match report.kind {
                ReportKind::State { state: DeviceState::Opening, .. } => {}
                ReportKind::State { state: DeviceState::Streaming, .. } => {
                    let player = server.client("paplay").arg("-d").arg("drag").arg(&path).spawn();
                    playing = Some((Instant::now(), player.unwrap()));
                }
                ReportKind::State { state, detail } => panic!("{state}: {detail}"),
                ReportKind::Warning(text) => warnings.push(text),
                other => panic!("{other:?}"),
            }
        }
    }
    let heard_s = heard.len() as f64 / f64::from(RATE_HZ);
    let (since, mut player) = playing.unwrap();
    let open_s = since.elapsed().as_secs_f64();
    stop.request();
    thread.join().unwrap().unwrap();
    assert!(player.wait().unwrap().success(), "paplay failed");
    assert_eq!((lost, tap.meter().counts().lost), (0, 0), "samples were lost");
    // As much sound as time has passed, but for what the server's buffer held or holds.
    assert!((heard_s - open_s).abs() < 0.5, "{heard_s} s of sound in {open_s} s");

    let (correlation, at) = find(&sound, &heard);
    eprintln!(
        "captured {heard_s:.3} s in {open_s:.3} s, none lost; the sound is at {:.3} s with a \
         correlation of {correlation:.6}; {warnings:?}",
        at as f64 / f64::from(RATE_HZ),
    );
    assert!(correlation > 0.999, "{correlation}");
    // The monitor of an idle sink is silent, which the driver must have said.
    assert!(warnings.iter().any(|text| text.contains("is silent")), "{warnings:?}");
}
