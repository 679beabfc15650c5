//! Carries sound from the callback's ring to the session, and counts by the clock what was lost.

use super::pace::Pace;
use super::{LevelWatch, RATE_HZ, SoundLevel};
use crate::ring::{Piece, SeriesSink, SeriesTap};

/// After a pause of this length, in seconds, sound may be missing without a report of it: a sound
/// server that was held up skips that time.
const PAUSE_S: f64 = 0.2;
/// The usual time after such a pause until late sound has arrived, in seconds.
const CATCH_UP_S: f64 = 0.25;

/// The state that lasts from one opening of the microphone to the next.
pub(super) struct Listening<'a> {
    sink: &'a mut SeriesSink,
    pace: Pace,
    level: LevelWatch,
    before: Before,
    /// The time of the last sound, or of the opening of the stream.
    last_s: f64,
    received: bool,
}

/// The event before the next frames.
#[derive(Clone, Copy, PartialEq)]
enum Before {
    Frames,
    /// A pause, and the time at which frames came again.
    Pause(f64),
    /// A loss of unknown size.
    Loss,
}

/// The result of reading the callback's ring.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Carried {
    /// Whether sound was carried.
    pub sound: bool,
    /// The level, if it has changed.
    pub level: Option<SoundLevel>,
}

impl<'a> Listening<'a> {
    pub fn new(sink: &'a mut SeriesSink) -> Self {
        let rate_hz = f64::from(RATE_HZ);
        Self {
            sink,
            pace: Pace::new(rate_hz),
            level: LevelWatch::new(rate_hz),
            before: Before::Frames,
            last_s: 0.0,
            received: false,
        }
    }

    /// Notes that a stream was opened, with its own ring.
    pub fn opened(&mut self, now_s: f64) {
        self.pace.reopened();
        self.last_s = now_s;
        self.before = if self.received { Before::Loss } else { Before::Frames };
    }

    /// Notes that sound was lost before the next sound that enters the ring.
    pub fn overrun(&mut self) {
        self.before = Before::Loss;
    }

    /// Whether sound has ever come.
    pub fn received(&self) -> bool {
        self.received
    }

    /// For how long no sound has come.
    pub fn silent_s(&self, now_s: f64) -> f64 {
        now_s - self.last_s
    }

    /// Whether sound comes much faster than in real time.
    pub fn unpaced(&self, now_s: f64) -> bool {
        self.pace.unpaced(now_s, self.sink.position())
    }

    /// Carries all frames of the ring to the session. After a pause it first waits for late ones,
    /// unless this is the `last` call for this ring.
    pub fn look(&mut self, tap: &mut SeriesTap, last: bool, clock: impl Fn() -> f64) -> Carried {
        // Frames that did not fit into the ring count like those in it.
        let held = tap.meter().counts().pushed.saturating_sub(tap.position());
        // The clock is read after the ring: a delay of this thread in between can make sound seem
        // late, but never early.
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
            Before::Pause(_) => self.pace.missing_for_sure(now_s, end),
            Before::Loss => self.pace.missing(now_s, end),
        };
        // Missing frames come before the frames that followed them.
        self.sink.skip(missing);
        self.pace.skipped(missing);
        // Sound that arrives after it was counted as lost has no place any more.
        let late = self.pace.late(now_s, end + missing).min(held);
        self.pace.came_late(late);
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::ring::{Waker, series};

    /// Length of one step of a simulation, in seconds and in frames.
    const STEP_S: f64 = 0.02;
    const STEP: u64 = 882;
    /// Frames of one callback, as ALSA calls it.
    const PERIOD: u64 = 512;
    /// Frames that the callback's ring holds here: too few for the sound that is held up, so that
    /// some is lost.
    const RING: usize = 22_050;
    /// The largest error of the frames counted, in seconds: a delay that is no loss, and 1.5 steps.
    const BOUND_S: f64 = 0.05 + 1.5 * STEP_S;

    /// A simulated sound server with its own clock, and the callback's ring.
    struct Hall {
        steps: u64,
        now_s: f64,
        enter: SeriesSink,
        tap: SeriesTap,
    }

    #[derive(Clone, Copy, Debug)]
    enum SinkAct {
        /// Sound for this number of steps.
        Play(u64),
        /// Nothing for `steps` steps. The share `passed_over` of their sound never comes; the rest
        /// comes at once, after `after` steps of new sound: if `piecewise`, the ring is read after
        /// each callback, else only after all of it.
        Stall { steps: u64, passed_over: f64, after: u64, piecewise: bool },
        /// Nothing for this number of steps, then the stream is opened again.
        Reopen(u64),
    }

    impl Hall {
        fn new() -> Self {
            let (enter, tap) = series(1, RING, Waker::new().0);
            Self { steps: 0, now_s: 0.0, enter, tap }
        }

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

        /// Sound that was held up arrives.
        fn burst(&mut self, listening: &mut Listening, mut frames: u64, piecewise: bool) {
            while frames > 0 {
                let part = if piecewise { frames.min(PERIOD) } else { frames };
                self.push(part);
                frames -= part;
                self.now_s += 0.000_05;
                self.look(listening);
            }
        }

        fn act(&mut self, listening: &mut Listening, act: SinkAct) {
            match act {
                SinkAct::Play(steps) => (0..steps).for_each(|_| self.step(listening, true)),
                SinkAct::Stall { steps, passed_over, after, piecewise } => {
                    (0..steps).for_each(|_| self.step(listening, false));
                    let never = (passed_over * (steps * STEP) as f64) as u64;
                    (0..after).for_each(|_| self.step(listening, true));
                    self.burst(listening, steps * STEP - never, piecewise);
                }
                SinkAct::Reopen(steps) => {
                    (0..steps).for_each(|_| self.step(listening, false));
                    (self.enter, self.tap) = series(1, RING, Waker::new().0);
                    listening.opened(self.now_s);
                }
            }
        }

        /// Plays these acts, with sound before and after each. Returns by how much the frames
        /// counted were ahead of the clock, and behind it, at worst, in seconds.
        fn play(&mut self, acts: &[SinkAct]) -> (f64, f64) {
            let (mut sink, mut tap) = series(1, 1 << 24, Waker::new().0);
            let meter = tap.meter().clone();
            let listening = &mut Listening::new(&mut sink);
            listening.opened(0.0);
            self.act(listening, SinkAct::Play(50));
            let mut worst_s = (0.0f64, 0.0f64);
            for &act in acts {
                self.act(listening, act);
                self.act(listening, SinkAct::Play(25));
                let counts = meter.counts();
                let off_s = self.now_s - counts.pushed as f64 / f64::from(RATE_HZ);
                worst_s = (worst_s.0.max(-off_s), worst_s.1.max(off_s));
            }
            tap.drain(|_| {});
            let counts = meter.counts();
            assert_eq!(counts.pushed, counts.received + counts.lost);
            worst_s
        }
    }

    #[track_caller]
    fn account_holds(acts: &[SinkAct]) {
        let (ahead_s, behind_s) = Hall::new().play(acts);
        assert!(ahead_s <= BOUND_S, "{ahead_s:.3} s too much of {acts:?}");
        assert!(behind_s <= BOUND_S, "{behind_s:.3} s uncounted of {acts:?}");
    }

    #[test]
    fn time_that_was_counted_as_lost_is_not_counted_again_when_its_sound_comes_late() {
        for piecewise in [true, false] {
            // The sound comes after the wait for it has ended, so it was counted as lost.
            let stall = SinkAct::Stall { steps: 30, passed_over: 0.0, after: 20, piecewise };
            account_holds(&[stall, stall]);
            account_holds(&[stall; 20]);
        }
    }

    #[test]
    fn what_the_callbacks_ring_lost_of_late_sound_is_counted_once() {
        let stall = SinkAct::Stall { steps: 75, passed_over: 0.0, after: 0, piecewise: false };
        account_holds(&[stall, stall, stall]);
    }

    #[test]
    fn small_remains_do_not_add_up() {
        // 40 ms come late each time: too little to be told from a mere delay.
        let stall = SinkAct::Stall { steps: 25, passed_over: 0.92, after: 20, piecewise: true };
        account_holds(&[stall; 50]);
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
