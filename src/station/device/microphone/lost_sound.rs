//! Carries sound from the callback's ring to the session, and finds lost sound by the clock. Estimates
//! how many frames an interruption cost, how many were only late, and whether the rate is right.

use super::{LevelWatch, SoundLevel};
use crate::ring::{Piece, SeriesSink, SeriesTap};

const RATE_HZ: f64 = super::RATE_HZ as f64;
/// Shortest pause, in seconds, that may hide a loss: a delayed sound server skips sound silently.
const PAUSE_S: f64 = 0.2;
/// Time in seconds within which late sound has usually arrived after a pause.
const CATCH_UP_S: f64 = 0.25;

/// The state of listening, which is kept when the microphone is reopened.
pub(super) struct Listening<'a> {
    sink: &'a mut SeriesSink,
    pace: Pace,
    level: LevelWatch,
    before: Before,
    /// Time of the last sound or, if later, of the opening of the stream.
    last_s: f64,
    received: bool,
}

#[derive(Clone, Copy, PartialEq)]
enum Before {
    Frames,
    /// A pause, with the time of the first frames after it.
    Pause(f64),
    Loss,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Carried {
    pub sound: bool,
    pub level: Option<SoundLevel>,
}

impl<'a> Listening<'a> {
    pub(super) fn new(sink: &'a mut SeriesSink) -> Self {
        let (pace, level, before) = (Pace::default(), LevelWatch::default(), Before::Frames);
        Self { sink, pace, level, before, last_s: 0.0, received: false }
    }

    /// To be called when a stream was opened, with a new ring.
    pub(super) fn opened(&mut self, now_s: f64) {
        // Watches the pace anew, since the stream may begin with old frames from a buffer.
        self.pace.first = None;
        self.last_s = now_s;
        self.before = if self.received { Before::Loss } else { Before::Frames };
    }

    /// To be called when sound was lost just before the next sound in the ring.
    pub(super) fn overrun(&mut self) {
        self.before = Before::Loss;
    }

    pub(super) fn silent_s(&self, now_s: f64) -> f64 {
        now_s - self.last_s
    }

    pub(super) fn unpaced(&self, now_s: f64) -> bool {
        self.pace.unpaced(now_s, self.sink.position())
    }

    /// Carries all frames in the ring to the session. After a pause, first waits for late frames,
    /// except in the `last` call for a ring.
    pub(super) fn look(
        &mut self,
        tap: &mut SeriesTap,
        last: bool,
        clock: impl Fn() -> f64,
    ) -> Carried {
        // `held` also counts frames that did not fit into the ring.
        let held = tap.meter().counts().pushed.saturating_sub(tap.position());
        // Reads the clock after the ring: sound may then seem late, but never early.
        let now_s = clock();
        if held == 0 {
            return Carried::default();
        }
        if self.before == Before::Frames && self.received && self.silent_s(now_s) > PAUSE_S {
            self.before = Before::Pause(now_s);
        }
        match self.before {
            Before::Pause(end_s) if now_s - end_s < CATCH_UP_S && !last => Carried::default(),
            _ => self.carry(tap, held, now_s),
        }
    }

    fn carry(&mut self, tap: &mut SeriesTap, held: u64, now_s: f64) -> Carried {
        let end = self.sink.position() + held;
        let missing = match std::mem::replace(&mut self.before, Before::Frames) {
            Before::Frames => 0,
            Before::Loss => self.pace.missing(now_s, end),
            // After a pause, few missing frames may only be delayed.
            Before::Pause(_) => match self.pace.missing(now_s, end) {
                few if (few as f64) < DELAY_S * RATE_HZ => 0,
                missing => missing,
            },
        };
        // Skips the missing frames first, since they come before the frames in the ring.
        self.sink.skip(missing);
        self.pace.skipped += missing;
        // Drops sound that was counted as lost and arrives late: its place is already filled.
        let late = self.pace.late(now_s, end + missing).min(held);
        self.pace.skipped -= late;
        self.pace.arrived(now_s, end + missing - late);
        let (mut late, mut level) = (late, None);
        tap.drain(|piece| match piece {
            Piece::Missing(frames) => {
                let gone = frames.min(late);
                late -= gone;
                self.sink.skip(frames - gone);
            }
            Piece::Samples(samples) => {
                let gone = late.min(samples.len() as u64);
                late -= gone;
                let samples = &samples[gone as usize..];
                self.sink.push(samples);
                level = self.level.take(samples).or(level);
            }
        });
        self.last_s = now_s;
        self.received = true;
        Carried { sound: true, level }
    }
}

/// Largest drift between two clocks, in seconds per second; it is usually far less.
const DRIFT: f64 = 500e-6;
/// Least difference, in seconds, that counts as a loss; a smaller one is a delay.
const DELAY_S: f64 = 0.05;
/// Most seconds of sound that a new stream may deliver at once.
const BURST_S: f64 = 4.0;
/// Time in seconds during which the pace of a new stream is watched.
const TRIAL_S: f64 = 5.0;

/// Estimates from arrival times how many frames are missing, and how many are only late.
///
/// A frame can come late, but not early. The start of the stream is thus estimated as the smallest
/// difference between a frame's arrival time and its own time in the stream. If this difference
/// grows by more than the usual delay, frames are missing. If it shrinks again, the frames counted
/// as missing were only late. They leave the estimate as it is, or one interruption would count twice.
#[derive(Default)]
struct Pace {
    /// The estimated start of the stream, and the time of the estimate, in seconds.
    begin: Option<(f64, f64)>,
    /// Time and position in the stream of the first arrival.
    first: Option<(f64, u64)>,
    /// Number of frames counted as missing that may still arrive late.
    skipped: u64,
}

impl Pace {
    /// Notes that frames arrived at `now_s`. `position` is the index after the last one; lost
    /// frames count in it.
    fn arrived(&mut self, now_s: f64, position: u64) {
        let seems = now_s - position as f64 / RATE_HZ;
        let begin = match self.begin {
            None => seems,
            Some((begin, at_s)) => {
                let drift = DRIFT * (now_s - at_s);
                let earliest = if self.skipped > 0 { begin - drift } else { f64::NEG_INFINITY };
                seems.min(begin + drift).max(earliest)
            }
        };
        self.begin = Some((begin, now_s));
        self.first.get_or_insert((now_s, position));
    }

    /// Estimates how many frames an interruption cost, from the arrival of the first frames after
    /// it at `now_s`. Their `position` does not count lost frames yet. The error is the delay of
    /// these frames, a few milliseconds.
    fn missing(&self, now_s: f64, position: u64) -> u64 {
        let Some((begin, at_s)) = self.begin else { return 0 };
        let late_s = now_s - position as f64 / RATE_HZ - begin - DRIFT * (now_s - at_s);
        (late_s * RATE_HZ).max(0.0) as u64
    }

    /// The number of frames that were counted as missing, but were only late: frames up to
    /// `position` arrived at `now_s`, too early for a stream with this many lost frames.
    fn late(&self, now_s: f64, position: u64) -> u64 {
        let Some((begin, at_s)) = self.begin else { return 0 };
        let early_s = begin - (now_s - position as f64 / RATE_HZ) - DRIFT * (now_s - at_s);
        let early = if early_s >= DELAY_S { (early_s * RATE_HZ) as u64 } else { 0 };
        early.min(self.skipped)
    }

    /// Whether frames come much faster than real time, like those of ALSA's null device.
    fn unpaced(&self, now_s: f64, position: u64) -> bool {
        let Some((first_s, first)) = self.first else { return false };
        let (elapsed_s, frames) = (now_s - first_s, position.saturating_sub(first));
        elapsed_s < TRIAL_S && frames as f64 / RATE_HZ > elapsed_s + BURST_S
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::ring::{Waker, series};

    /// Length of a simulation step, in seconds and in frames.
    const STEP_S: f64 = 0.02;
    const STEP: u64 = 882;
    /// Usual number of frames in a callback of ALSA.
    const PERIOD: u64 = 512;
    /// Length of the callback's ring in frames: too short for all delayed sound, so some is lost.
    const RING: usize = 22_050;
    /// Largest allowed error of the counts, in seconds: a delay that is no loss, and 1.5 steps.
    const BOUND_S: f64 = 0.05 + 1.5 * STEP_S;

    /// A simulated sound server with a clock, and the callback's ring.
    struct Hall {
        steps: u64,
        now_s: f64,
        enter: SeriesSink,
        tap: SeriesTap,
    }

    #[derive(Clone, Copy, Debug)]
    enum SinkAct {
        Play(u64),
        /// Pauses for `steps` steps. The share `passed_over` of their sound never arrives. The rest
        /// arrives in one burst, after `after` more steps with sound. During the burst, the ring is
        /// read after each callback if `piecewise`, otherwise once at the end.
        Stall {
            steps: u64,
            passed_over: f64,
            after: u64,
            piecewise: bool,
        },
        /// Pauses for this number of steps, then reopens the stream.
        Reopen(u64),
    }

    impl Hall {
        fn look(&mut self, listening: &mut Listening) {
            listening.look(&mut self.tap, false, || self.now_s);
        }

        fn push(&mut self, frames: u64) {
            self.enter.push(&vec![0.1; frames as usize]);
        }

        fn step(&mut self, listening: &mut Listening, sounds: bool) {
            self.steps += 1;
            self.now_s = self.steps as f64 * STEP_S;
            if sounds {
                self.push(STEP);
            }
            self.look(listening);
        }

        fn act(&mut self, listening: &mut Listening, act: SinkAct) {
            match act {
                SinkAct::Play(steps) => (0..steps).for_each(|_| self.step(listening, true)),
                SinkAct::Stall { steps, passed_over, after, piecewise } => {
                    (0..steps).for_each(|_| self.step(listening, false));
                    let never = (passed_over * (steps * STEP) as f64) as u64;
                    (0..after).for_each(|_| self.step(listening, true));
                    let mut frames = steps * STEP - never;
                    while frames > 0 {
                        let part = if piecewise { frames.min(PERIOD) } else { frames };
                        self.push(part);
                        frames -= part;
                        self.now_s += 0.000_05;
                        self.look(listening);
                    }
                }
                SinkAct::Reopen(steps) => {
                    (0..steps).for_each(|_| self.step(listening, false));
                    (self.enter, self.tap) = series(1, RING, Waker::new().0);
                    listening.opened(self.now_s);
                }
            }
        }
    }

    /// Plays these acts, with sound before and after each, and checks how far the counted frames are
    /// ahead of the clock and behind it.
    #[track_caller]
    fn account_holds(acts: &[SinkAct]) {
        let (enter, tap) = series(1, RING, Waker::new().0);
        let mut hall = Hall { steps: 0, now_s: 0.0, enter, tap };
        let (mut sink, mut tap) = series(1, 1 << 24, Waker::new().0);
        let meter = tap.meter().clone();
        let listening = &mut Listening::new(&mut sink);
        listening.opened(0.0);
        hall.act(listening, SinkAct::Play(50));
        for &act in acts {
            hall.act(listening, act);
            hall.act(listening, SinkAct::Play(25));
            let behind_s = hall.now_s - meter.counts().pushed as f64 / RATE_HZ;
            assert!(-behind_s <= BOUND_S, "{:.3} s too much of {acts:?}", -behind_s);
            assert!(behind_s <= BOUND_S, "{behind_s:.3} s uncounted of {acts:?}");
        }
        tap.drain(|_| {});
        let counts = meter.counts();
        assert_eq!(counts.pushed, counts.received + counts.lost);
    }

    #[test]
    fn sound_that_comes_late_is_counted_once_however_often() {
        // Steps of the pause, the share that never comes, steps before the rest comes.
        for (steps, passed_over, after, times) in [
            // Comes too late to be waited for, so it first counts as lost.
            (30, 0.0, 20, 20),
            // Too much for the callback's ring.
            (75, 0.0, 0, 3),
            // 40 ms late, too little to tell a loss from a delay.
            (25, 0.92, 20, 50),
        ] {
            for piecewise in [true, false] {
                let stall = SinkAct::Stall { steps, passed_over, after, piecewise };
                account_holds(&vec![stall; times]);
            }
        }
    }

    const BLOCK: u64 = 441;

    /// Delivers frames for some seconds, with a varying delay, by a clock that is off by `drift`.
    fn run(pace: &mut Pace, from: (f64, u64), seconds: f64, drift: f64) -> (f64, u64) {
        let (mut now_s, mut position) = from;
        for i in 0..(seconds * 100.0) as u64 {
            now_s += 0.01 * (1.0 + drift);
            position += BLOCK;
            pace.arrived(now_s + (i * 7 % 11) as f64 * 0.0005, position);
        }
        (now_s, position)
    }

    #[test]
    fn an_interruption_is_measured_to_within_ten_milliseconds() {
        for drift in [-100e-6, 0.0, 100e-6] {
            let mut pace = Pace::default();
            let (now_s, position) = run(&mut pace, (5.0, 0), 600.0, drift);
            assert_eq!(pace.missing(now_s + 0.01, position + BLOCK) / 441, 0);
            let missing = pace.missing(now_s + 2.01, position + BLOCK) as f64 / RATE_HZ;
            assert!((missing - 2.0).abs() < 0.01, "{missing}");
            // Once the loss is counted, nothing is missing any more.
            let position = position + BLOCK + pace.missing(now_s + 2.01, position + BLOCK);
            pace.arrived(now_s + 2.01, position);
            let (now_s, position) = run(&mut pace, (now_s + 2.01, position), 10.0, drift);
            assert!(pace.missing(now_s + 0.01, position + BLOCK) < 441);
        }
    }

    #[test]
    fn a_stream_without_a_pace_is_distinguished_from_one_that_begins_with_a_full_buffer() {
        let mut pace = Pace::default();
        pace.arrived(0.0, 441);
        assert!(!pace.unpaced(0.1, 2 * 44_100));
        assert!(pace.unpaced(0.5, 10 * 44_100));
        let (now_s, position) = run(&mut pace, (0.0, 441), 4.0, 0.0);
        assert!(!pace.unpaced(now_s, position));
    }

    proptest! {
        #[test]
        fn whatever_stalls_passes_over_or_comes_late_received_and_lost_are_what_was_recorded(
            acts in prop::collection::vec(
                prop_oneof![
                    (15u64..150, prop_oneof![Just(0.0), Just(1.0), 0.0..1.0], 0u64..40, any::<bool>())
                        .prop_map(|(steps, passed_over, after, piecewise)|
                            SinkAct::Stall { steps, passed_over, after, piecewise }),
                    (1u64..100).prop_map(SinkAct::Reopen),
                ],
                1..12,
            ),
        ) {
            account_holds(&acts);
        }
    }
}
