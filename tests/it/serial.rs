//! The stylus's driver against a stylus on a pseudo-terminal that misbehaves in every way.

use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::common::http::SOON;
use crate::common::stylus::{Fake, NAMES, RATE_HZ, value};
use crossbeam_channel::Receiver;
use surfaced::device::serial::{Selector, Stylus};
use surfaced::device::{
    Device, DeviceLink, DeviceReport, DeviceReportKind, DeviceState, OpenError,
};
use surfaced::ring::{Piece, SeriesTap, Sink, Stop, Waker, series};
use surfaced::station::config::{StationConfig, StylusConfig};
use surfaced_wire::Command;

/// A driver at work.
struct Bench {
    link: PathBuf,
    _dir: tempfile::TempDir,
    taps: Vec<SeriesTap>,
    got: Vec<Vec<f32>>,
    reports: Receiver<DeviceReport>,
    states: Vec<DeviceState>,
    texts: Vec<String>,
    stop: Stop,
    thread: Option<JoinHandle<()>>,
}

/// The driver of the stylus that `link` leads to.
fn driver(link: &Path) -> Stylus {
    let config = StationConfig::embedded().stylus.unwrap();
    Stylus::new(StylusConfig { port: Selector::Path(link.into()), ..config })
}

fn bench() -> Bench {
    let dir = tempfile::tempdir().unwrap();
    let link = dir.path().join("stylus");
    let (sender, reports) = crossbeam_channel::bounded(1024);
    Bench {
        link,
        _dir: dir,
        taps: Vec::new(),
        got: vec![Vec::new(); 4],
        reports,
        states: Vec::new(),
        texts: Vec::new(),
        stop: Stop::default(),
        thread: None,
    }
    .start(sender)
}

impl Bench {
    fn start(mut self, sender: crossbeam_channel::Sender<DeviceReport>) -> Self {
        let mut stylus = driver(&self.link);
        let mut sinks = Vec::new();
        for spec in stylus.streams() {
            let channels = match spec.id.as_str() {
                "ac" => 3,
                "fr" => 2,
                _ => 1,
            };
            // 40 s: nobody drains while a script runs.
            let (sink, tap) = series(channels, 400_000, Waker::new().0);
            sinks.push(Sink::Series(sink));
            self.taps.push(tap);
        }
        let control = DeviceLink::new(0, self.stop.clone(), sender);
        self.thread = Some(std::thread::spawn(move || stylus.run(&mut sinks, &control).unwrap()));
        self
    }

    /// Takes what has come: samples, missing ones as NaN, and reports.
    fn take(&mut self) {
        for (tap, got) in self.taps.iter_mut().zip(&mut self.got) {
            let channels = tap.channels();
            tap.drain(|piece| match piece {
                Piece::Samples(samples) => got.extend_from_slice(samples),
                Piece::Missing(n) => {
                    got.extend(std::iter::repeat_n(f32::NAN, n as usize * channels));
                }
            });
        }
        for report in self.reports.try_iter() {
            match report.kind {
                DeviceReportKind::State { state, detail } => {
                    self.states.push(state);
                    self.texts.push(detail);
                }
                DeviceReportKind::Warning(warning) => self.texts.push(warning.text),
                other => panic!("{other:?}"),
            }
        }
    }

    /// Waits until the device was in this state for the `nth` time.
    fn until(&mut self, state: DeviceState, nth: usize) {
        let limit = Instant::now() + SOON;
        while self.states.iter().filter(|s| **s == state).count() < nth {
            assert!(Instant::now() < limit, "{:?} {:?}", self.states, self.texts);
            std::thread::sleep(Duration::from_millis(5));
            self.take();
        }
    }

    fn end(&mut self, fake: &mut Fake) {
        self.stop.request();
        let thread = self.thread.take().unwrap();
        while !thread.is_finished() {
            fake.obey();
        }
        thread.join().unwrap();
        self.take();
        let frames: Vec<_> = self.got.iter().zip([3, 2, 1, 1]).map(|(g, c)| g.len() / c).collect();
        assert!(frames.iter().all(|n| *n == frames[0]), "{frames:?}");
    }

    /// The infrared channel's runs of samples: index of the first, samples, missing before it.
    fn runs(&self) -> Vec<(u64, u64, u64)> {
        let ir: Vec<i32> = self.got[2]
            .iter()
            .map(|x| if x.is_nan() { -1 } else { (x * 32_768.0) as i32 })
            .collect();
        let (mut runs, mut missing) = (Vec::<(u64, u64, u64)>::new(), 0);
        let mut last = -1;
        for &x in &ir {
            if x < 0 {
                missing += 1;
                last = -1;
                continue;
            }
            assert_eq!((x - 5) % 7, 0);
            let follows = last >= 0 && ((x - 5) / 7) as u64 == ((last - 5) / 7 + 1) as u64 % 4000;
            match runs.last_mut() {
                Some(run) if follows => run.1 += 1,
                _ => runs.push((((x - 5) / 7) as u64, 1, std::mem::take(&mut missing))),
            }
            last = x;
        }
        runs
    }
}

#[test]
fn all_samples_arrive_in_order_and_scaled() {
    let mut b = bench();
    b.until(DeviceState::Absent, 1);
    let mut fake = Fake::plug(&b.link);
    // Commands that are lost on the way are repeated.
    fake.deaf = 3;
    fake.wait_for_start();
    fake.serve(1.0);
    let sent = fake.next.unwrap();
    std::thread::sleep(Duration::from_millis(100));
    b.end(&mut fake);
    assert_eq!(b.runs(), [(0, sent, 0)]);
    let full = |c| f32::from(value(0, c)) / 32_768.0;
    assert_eq!(b.got[0][..3], [full(0), full(1), full(2)]);
    assert_eq!(b.got[1][..2], [full(3), full(4)]);
    assert_eq!(b.got[3][..2], [6.0, 13.0], "metal is in its own unit");
    use DeviceState::{Absent, Opening, Streaming};
    // Being deaf may take so long that it shows as a stall.
    b.states.retain(|state| *state != DeviceState::Stalled);
    assert_eq!(b.states, [Absent, Opening, Streaming]);
    assert_eq!(fake.commands.last(), Some(&Command::Stop));
}

#[test]
fn a_stall_is_reported_and_its_gap_counted() {
    let mut b = bench();
    let mut fake = Fake::plug(&b.link);
    fake.wait_for_start();
    fake.serve(0.3);
    let before = fake.next.unwrap();
    b.until(DeviceState::Stalled, 1);
    fake.next = Some(before + 8_000);
    fake.serve(0.3);
    let after = fake.next.unwrap() - before - 8_000;
    b.until(DeviceState::Streaming, 2);
    b.end(&mut fake);
    assert_eq!(b.runs(), [(0, before, 0), ((before + 8_000) % 4000, after, 8_000)]);
}

#[test]
fn a_flood_is_taken_in_or_counted_as_lost() {
    let mut b = bench();
    let mut fake = Fake::plug(&b.link);
    fake.wait_for_start();
    let begin = Instant::now();
    while fake.next.unwrap() < 300_000 {
        fake.samples(64);
    }
    println!("{:.0} samples/s through the pty", 300_000.0 / begin.elapsed().as_secs_f64());
    std::thread::sleep(Duration::from_millis(200));
    b.end(&mut fake);
    assert_eq!(b.got[2].len(), 300_032);
    assert!(b.got[2].iter().all(|x| !x.is_nan()));
}

#[test]
fn a_reset_is_a_gap_that_no_scan_bridges() {
    let mut b = bench();
    let mut fake = Fake::plug(&b.link);
    fake.wait_for_start();
    fake.serve(0.3);
    let before = fake.next.unwrap();
    // Booted again: a hello, then silence until it is started.
    fake.next = None;
    fake.hello();
    fake.wait_for_start();
    fake.serve(0.3);
    let after = fake.next.unwrap();
    std::thread::sleep(Duration::from_millis(100));
    b.end(&mut fake);
    let runs = b.runs();
    assert_eq!((runs.len(), runs[0]), (2, (0, before, 0)));
    assert_eq!((runs[1].0, runs[1].1), (0, after));
    // Restarted 0.5 s after its last sample; 20 ms of it can be mere delays.
    assert!((4_500..20_000).contains(&runs[1].2), "{runs:?}");
    assert!(
        b.texts.iter().any(|text| text.contains("restarts of its sample counter")),
        "{:?}",
        b.texts
    );
}

#[test]
fn garbage_costs_the_frames_it_hits_and_no_others() {
    let mut b = bench();
    let mut fake = Fake::plug(&b.link);
    fake.wait_for_start();
    let mut seed = 1u32;
    for round in 0..200 {
        fake.samples(32);
        if round % 10 == 5 {
            // Cut short by the next delimiter within it, which spoils the following frame too.
            let noise: Vec<u8> = (0..300)
                .map(|_| {
                    seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    (seed >> 24) as u8
                })
                .collect();
            fake.put(&noise);
        }
    }
    std::thread::sleep(Duration::from_millis(300));
    b.end(&mut fake);
    let missing: u64 = b.runs().iter().map(|run| run.2).sum();
    assert_eq!(missing, 20 * 32, "{:?}", b.runs());
    assert!(b.runs().iter().all(|run| run.2 == 0 || run.2 == 32));
    assert!(b.texts.iter().any(|text| text.contains("frames were damaged")), "{:?}", b.texts);
}

#[test]
fn a_channel_table_that_changes_is_followed() {
    let mut b = bench();
    let mut fake = Fake::plug(&b.link);
    fake.wait_for_start();
    fake.samples(32);
    fake.names = vec!["metal", "ir", "fsr_2", "fsr_1", "acc_z", "acc_y", "acc_x"];
    fake.hello();
    fake.samples(32);
    std::thread::sleep(Duration::from_millis(200));
    b.end(&mut fake);
    assert_eq!(b.runs(), [(0, 64, 0)]);
    assert!(b.texts.iter().any(|text| text.contains("channels have changed")), "{:?}", b.texts);
}

#[test]
fn alternating_hellos_give_a_warning_a_second_whatever_their_number() {
    const HELLOS: u64 = 20_000;
    let mut b = bench();
    let mut fake = Fake::plug(&b.link);
    fake.wait_for_start();
    let begin = Instant::now();
    let (whole, without_metal) = (NAMES.to_vec(), NAMES[..6].to_vec());
    for n in 0..HELLOS {
        fake.names = if n % 2 == 0 { without_metal.clone() } else { whole.clone() };
        fake.hello();
        b.take();
    }
    fake.samples(32);
    std::thread::sleep(Duration::from_millis(200));
    b.end(&mut fake);
    let of_hellos = |text: &&String| text.contains("channels");
    let warnings: Vec<&String> = b.texts.iter().filter(of_hellos).collect();
    let seconds = begin.elapsed().as_secs();
    assert!((1..=seconds as usize + 2).contains(&warnings.len()), "{seconds} s: {warnings:?}");
    // Each says how many it stands for: a change each, and each other one lacks a channel.
    let stands_for = |text: &&String| {
        let more = text.rsplit_once("(and ").and_then(|(_, rest)| rest.split(' ').next());
        1 + more.map_or(0, |more| more.parse::<u64>().unwrap())
    };
    assert_eq!(warnings.iter().map(stands_for).sum::<u64>(), HELLOS + HELLOS / 2, "{warnings:?}");
    assert_eq!(b.got[2].len(), 32, "and samples are taken as before");
}

#[test]
fn a_stylus_with_the_wrong_channels_is_refused_with_the_reason() {
    let mut b = bench();
    let mut fake = Fake::plug(&b.link);
    fake.names = vec!["acc_x", "acc_y"];
    fake.wait_for_start();
    fake.serve(0.7);
    b.until(DeviceState::Stalled, 1);
    b.end(&mut fake);
    assert!(b.texts.iter().any(|text| text.contains("acc_x, acc_y")), "{:?}", b.texts);
    assert!(b.got[2].is_empty());
}

#[test]
fn unplugged_and_back_the_loss_is_what_the_clock_says() {
    let mut b = bench();
    let mut fake = Fake::plug(&b.link);
    fake.wait_for_start();
    fake.serve(0.4);
    b.until(DeviceState::Streaming, 1);
    let gone = Instant::now();
    let _ = std::fs::remove_file(&b.link);
    drop(fake);
    b.until(DeviceState::Lost, 1);
    let mut fake = Fake::plug(&b.link);
    fake.wait_for_start();
    let away_s = gone.elapsed().as_secs_f64();
    fake.serve(0.4);
    let after = fake.next.unwrap();
    b.until(DeviceState::Streaming, 2);
    std::thread::sleep(Duration::from_millis(100));
    b.end(&mut fake);
    use DeviceState::{Lost, Opening, Streaming};
    let states = b.states.iter().filter(|s| **s != DeviceState::Absent).copied();
    assert_eq!(states.collect::<Vec<_>>(), [Opening, Streaming, Lost, Opening, Streaming]);
    let last = *b.runs().last().unwrap();
    assert_eq!((last.0, last.1), (0, after));
    let error = last.2 as f64 / RATE_HZ as f64 - away_s;
    assert!(error.abs() < 0.3, "{error}");
}

#[test]
fn a_port_that_another_has_is_busy_and_one_that_is_not_there_absent() {
    let dir = tempfile::tempdir().unwrap();
    let link = dir.path().join("stylus");
    let selector = Selector::Path(link.clone());
    assert!(matches!(selector.open(), Err(OpenError::Absent(_))));
    let _fake = Fake::plug(&link);
    let held = selector.open().unwrap();
    assert!(matches!(selector.open(), Err(OpenError::Busy(_))));
    drop(held);
    assert!(selector.open().is_ok());
}

#[test]
fn the_light_is_asked_for_until_it_is_on() {
    let dir = tempfile::tempdir().unwrap();
    let link = dir.path().join("stylus");
    let mut fake = Fake::plug(&link);
    let mut stylus = driver(&link);
    let light = stylus.light.clone();
    light.set(true);
    let (sender, _reports) = crossbeam_channel::bounded(1024);
    let stop = Stop::default();
    let control = DeviceLink::new(0, stop.clone(), sender);
    let thread = std::thread::spawn(move || stylus.run(&mut [], &control).unwrap());
    fake.wait_for_start();
    fake.deaf = 2;
    let limit = Instant::now() + SOON;
    while !light.is_on() {
        assert!(Instant::now() < limit, "{:?}", fake.commands);
        fake.obey();
    }
    assert!(fake.commands.iter().filter(|c| **c == Command::LightOn).count() >= 2);
    stop.request();
    while !thread.is_finished() {
        fake.obey();
    }
    thread.join().unwrap();
}
