//! The microphone's driver on a real sound server (see `common::sound`): a real dragging sound is
//! played into it.
#![cfg(feature = "microphone")]

mod common;

use std::path::Path;
use std::process::Child;
use std::time::{Duration, Instant};

use common::http::SOON;
use common::sound::{SINK, Server};
use common::{id, shared};
use realfft::RealFftPlanner;
use surfaced::device::microphone::{Alsa, Microphone, Pick, RATE_HZ};
use surfaced::device::{Device, DeviceLink, DeviceReportKind, DeviceState};
use surfaced::ring::{Piece, Sink, Stop, Waker, series};

const SOUND: &str = "data/LMT_108_SurfaceMaterials_Database/SoundScans/Movement/Training/\
                     G4CherryTree_Sound_Movement_train10.wav";
/// Silence before and after the sound, in seconds: time for the player to start, and to drain.
const MARGIN_S: f64 = 1.5;

/// The best normalised cross-correlation of `sound` with a stretch of `recorded`, and where it is.
fn find(sound: &[f32], recorded: &[f32]) -> (f64, usize) {
    let n = (sound.len() + recorded.len()).next_power_of_two();
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
        spectrum(recorded).iter().zip(spectrum(sound)).map(|(h, s)| h * s.conj()).collect();
    // The inverse would refuse the remains of rounding there.
    (product[0].im, product[n / 2].im) = (0.0, 0.0);
    let mut lags = back.make_output_vec();
    back.process(&mut product, &mut lags).unwrap();
    let squares = |x: &[f32]| x.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>();
    let energy = squares(sound);
    (0..=recorded.len() - sound.len())
        .map(|lag| (lags[lag] / n as f64, lag))
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(sum, lag)| (sum / (energy * squares(&recorded[lag..lag + sound.len()])).sqrt(), lag))
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

    let alsa = Box::new(Alsa::new("default").unwrap());
    let mut microphone = Microphone::new(id("mi2"), "default", Pick::Mean, alsa);
    let (waker, woken) = Waker::new();
    let (sink, mut tap) = series(1, RATE_HZ as usize, waker);
    let (sender, reports) = crossbeam_channel::unbounded();
    let stop = Stop::default();
    let control = DeviceLink::new(0, stop.clone(), sender);
    let thread = std::thread::spawn(move || {
        let mut sinks = [Sink::Series(sink)];
        microphone.run(&mut sinks, &control)
    });

    // When the first sound was streamed, and the player that was started then.
    let mut playing: Option<(Instant, Child)> = None;
    let (mut recorded, mut lost, mut warnings) = (Vec::new(), 0, Vec::new());
    let begin = Instant::now();
    let length = Duration::from_secs_f64(sound_s + 2.0 * MARGIN_S);
    while playing.as_ref().is_none_or(|(since, _)| since.elapsed() < length) {
        assert!(begin.elapsed() < SOON, "the microphone never streamed");
        let _ = woken.recv_timeout(Duration::from_millis(10));
        tap.drain(|piece| match piece {
            Piece::Samples(samples) => recorded.extend_from_slice(samples),
            Piece::Missing(frames) => lost += frames,
        });
        for report in reports.try_iter() {
            match report.kind {
                DeviceReportKind::State { state: DeviceState::Opening, .. } => {}
                DeviceReportKind::State { state: DeviceState::Streaming, .. } => {
                    let player = server.client("paplay").arg("-d").arg(SINK).arg(&path).spawn();
                    playing = Some((Instant::now(), player.unwrap()));
                }
                // A server that has just started may take a while over its first sound.
                DeviceReportKind::State { state: DeviceState::Stalled, .. }
                    if playing.is_none() => {}
                DeviceReportKind::State { state, detail } => panic!("{state}: {detail}"),
                DeviceReportKind::Warning(warning) => warnings.push(warning.text),
                other => panic!("{other:?}"),
            }
        }
    }
    let recorded_s = recorded.len() as f64 / f64::from(RATE_HZ);
    let (since, mut player) = playing.unwrap();
    let open_s = since.elapsed().as_secs_f64();
    stop.request();
    thread.join().unwrap().unwrap();
    assert!(player.wait().unwrap().success(), "paplay failed");
    assert_eq!((lost, tap.meter().counts().lost), (0, 0), "samples were lost");
    // As much sound as time has passed, give or take what the server's buffer holds.
    assert!((recorded_s - open_s).abs() < 0.5, "{recorded_s} s of sound in {open_s} s");

    // The server's sink may swallow a little while it starts and stops to play.
    let rim = (0.1 * f64::from(RATE_HZ)) as usize;
    let (correlation, at) = find(&sound[rim..sound.len() - rim], &recorded);
    eprintln!(
        "captured {recorded_s:.3} s in {open_s:.3} s, none lost; the sound is at {:.3} s with a \
         correlation of {correlation:.6}; {warnings:?}",
        at as f64 / f64::from(RATE_HZ),
    );
    assert!(correlation > 0.999, "{correlation}");
    // The monitor of an idle sink is silent, which the driver must have said.
    assert!(warnings.iter().any(|text| text.contains("pure silence")), "{warnings:?}");
}
