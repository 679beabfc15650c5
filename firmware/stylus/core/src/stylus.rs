//! The main loop's side: obeys commands and sends frames.

use surfaced_wire::{
    Channel, Command, Decoder, Hello, MAX_ENCODED, Message, SAMPLES_PER_FRAME, STYLUS_CHANNELS,
    Samples, Status, encode,
};

use crate::{ByteRing, Sample, Sampling};

/// Bytes of one sample on the wire.
const SAMPLE_BYTES: usize = 2 * STYLUS_CHANNELS;

/// Settings that do not change while the stylus runs.
#[derive(Debug, Clone, Copy)]
pub struct Identity<'a> {
    /// Serial number of the device.
    pub serial: &'a str,
    /// Version of the firmware.
    pub firmware: [u8; 3],
    /// Ticks of the sampling clock per second.
    pub sample_rate_hz: u32,
    /// The name, scale and unit of each channel.
    pub channels: &'a [Channel<'a>],
    /// Whether the crystal failed; see [`Status::crystal_failed`].
    pub crystal_failed: bool,
}

/// The state of the dialogue with the daemon.
pub struct Stylus<'a> {
    identity: Identity<'a>,
    decoder: Decoder,
    block: [u8; SAMPLES_PER_FRAME * SAMPLE_BYTES],
    /// Number of samples in the block, and index of the first.
    filled: usize,
    first_index: u64,
    next_index: u64,
    samples_sent: u64,
    frames_sent: u64,
    light: bool,
    hello_due: bool,
    status_due: bool,
    /// When the index reaches this value, the next regular status is due.
    status_at: u64,
}

impl<'a> Stylus<'a> {
    /// A stylus that has not introduced itself yet.
    #[must_use]
    pub fn new(identity: Identity<'a>) -> Self {
        Self {
            identity,
            decoder: Decoder::new(),
            block: [0; SAMPLES_PER_FRAME * SAMPLE_BYTES],
            filled: 0,
            first_index: 0,
            next_index: 0,
            samples_sent: 0,
            frames_sent: 0,
            light: false,
            hello_due: true,
            status_due: false,
            status_at: 0,
        }
    }

    /// Whether the camera's light should be on.
    #[must_use]
    pub fn light(&self) -> bool {
        self.light
    }

    /// Number of samples sent since the start.
    #[must_use]
    pub fn samples_sent(&self) -> u64 {
        self.samples_sent
    }

    /// Number of frames of samples sent since the start.
    #[must_use]
    pub fn frames_sent(&self) -> u64 {
        self.frames_sent
    }

    /// One round of the main loop: obeys received commands and sends what is due, if there is room.
    /// Returns whether nothing is left to do until the next interrupt.
    pub fn poll<const R: usize, const T: usize>(
        &mut self,
        sampling: &Sampling,
        received: &ByteRing<R>,
        line: &ByteRing<T>,
    ) -> bool {
        while let Some(byte) = received.pop() {
            let command = match self.decoder.next(&mut &[byte][..]) {
                Some(Ok(Message::Command(command))) => command,
                // The stylus does not answer damaged bytes; the daemon repeats its command.
                _ => continue,
            };
            self.obey(command, sampling);
        }
        if self.hello_due && room(line) {
            self.hello_due = false;
            let Identity { serial, firmware, sample_rate_hz, channels, .. } = self.identity;
            let channels = channels.into();
            send(line, &Message::Hello(Hello { serial, firmware, sample_rate_hz, channels }));
        }
        let was_on = sampling.is_on();
        let mut emptied = false;
        while room(line) {
            let Some(sample) = sampling.ring.pop() else {
                emptied = true;
                // Sampling stopped before the ring was found empty, so no sample can follow.
                if !was_on {
                    self.flush(line);
                }
                break;
            };
            self.take(sample, line);
        }
        if self.next_index >= self.status_at {
            self.status_at = self.next_index + u64::from(self.identity.sample_rate_hz);
            self.status_due |= was_on;
        }
        if self.status_due && room(line) && (was_on || emptied) {
            self.status_due = false;
            send(line, &Message::Status(self.status(sampling)));
        }
        !(self.hello_due || self.status_due)
    }

    /// Sends a status to the daemon at the next opportunity.
    pub fn report(&mut self) {
        self.status_due = true;
    }

    fn obey(&mut self, command: Command, sampling: &Sampling) {
        match command {
            Command::Start => {
                self.hello_due = true;
                if !sampling.is_on() {
                    self.filled = 0;
                    self.next_index = 0;
                    self.samples_sent = 0;
                    self.frames_sent = 0;
                    self.status_at = u64::from(self.identity.sample_rate_hz);
                    sampling.start();
                }
            }
            Command::Stop => sampling.stop(),
            Command::Identify => self.hello_due = true,
            Command::LightOff => self.light = false,
            Command::LightOn => self.light = true,
        }
        self.status_due = true;
    }

    fn take<const T: usize>(&mut self, sample: Sample, line: &ByteRing<T>) {
        // The ring's 32-bit tick is never 2^32 ticks behind, so the difference gives the full index.
        let ahead = sample.tick.wrapping_sub(self.next_index as u32);
        let index = self.next_index + u64::from(ahead);
        if ahead > 0 {
            // A frame holds consecutive samples only.
            self.flush(line);
        }
        if self.filled == 0 {
            self.first_index = index;
        }
        self.next_index = index + 1;
        let slot = &mut self.block[self.filled * SAMPLE_BYTES..][..SAMPLE_BYTES];
        for (pair, value) in slot.as_chunks_mut().0.iter_mut().zip(sample.values) {
            *pair = value.to_le_bytes();
        }
        self.filled += 1;
        if self.filled == SAMPLES_PER_FRAME {
            self.flush(line);
        }
    }

    /// Sends the samples of the block. The caller has checked that there is room.
    fn flush<const T: usize>(&mut self, line: &ByteRing<T>) {
        let bytes = &self.block[..self.filled * SAMPLE_BYTES];
        if let Ok(samples) = Samples::new(self.first_index, STYLUS_CHANNELS, bytes)
            && send(line, &Message::Samples(samples))
        {
            self.samples_sent += self.filled as u64;
            self.frames_sent += 1;
        }
        self.filled = 0;
    }

    fn status(&self, sampling: &Sampling) -> Status {
        Status {
            samples_sent: self.samples_sent,
            overruns: sampling.overruns(),
            dropped: sampling.dropped(),
            temperature_centi_c: None,
            sampling: sampling.is_on(),
            light: self.light,
            crystal_failed: self.identity.crystal_failed,
        }
    }
}

fn room<const T: usize>(line: &ByteRing<T>) -> bool {
    line.free() >= MAX_ENCODED
}

fn send<const T: usize>(line: &ByteRing<T>, message: &Message<'_>) -> bool {
    let mut out = [0; MAX_ENCODED];
    match encode(message, &mut out) {
        Ok(n) => line.push(&out[..n]),
        Err(_) => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Bench {
        stylus: Stylus<'static>,
        sampling: Sampling,
        to: ByteRing<256>,
        from: ByteRing<4096>,
    }

    /// A message as the daemon sees it: its kind; for samples, index, count and first value.
    #[derive(Debug, PartialEq)]
    enum Seen {
        Hello,
        Samples(u64, usize, i16),
        Status(Status),
    }

    fn bench() -> Bench {
        let identity = Identity {
            serial: "test",
            firmware: [0, 1, 0],
            sample_rate_hz: 10_000,
            channels: &[Channel { name: "x", scale: 1.0, unit: "" }; STYLUS_CHANNELS],
            crystal_failed: false,
        };
        Bench {
            stylus: Stylus::new(identity),
            sampling: Sampling::new(),
            to: ByteRing::new(),
            from: ByteRing::new(),
        }
    }

    impl Bench {
        fn command(&mut self, command: Command) {
            let mut out = [0; MAX_ENCODED];
            let n = encode(&Message::Command(command), &mut out).unwrap();
            assert!(self.to.push(&out[..n]));
        }

        fn poll(&mut self) {
            self.stylus.poll(&self.sampling, &self.to, &self.from);
        }

        fn tick(&mut self, elapsed: u32, value: i16) {
            self.sampling.tick(elapsed, || Some([value; STYLUS_CHANNELS]));
        }

        fn seen(&mut self) -> Vec<Seen> {
            let bytes: Vec<u8> = std::iter::from_fn(|| self.from.pop()).collect();
            let (mut decoder, mut input, mut seen) = (Decoder::new(), &bytes[..], Vec::new());
            while let Some(message) = decoder.next(&mut input) {
                seen.push(match message.expect("an undamaged line") {
                    Message::Hello(_) => Seen::Hello,
                    Message::Samples(s) => {
                        Seen::Samples(s.first_index(), s.count(), s.values().next().unwrap())
                    }
                    Message::Status(s) => Seen::Status(s),
                    Message::Command(_) => unreachable!("the stylus commands nobody"),
                });
            }
            seen
        }
    }

    #[test]
    fn hello_comes_first_and_samples_only_after_start() {
        let mut b = bench();
        b.tick(1, 5);
        b.poll();
        assert_eq!(b.seen(), [Seen::Hello]);
        b.command(Command::Start);
        b.poll();
        assert!(matches!(b.seen()[..], [Seen::Hello, Seen::Status(Status { sampling: true, .. })]));
        for i in 0..64 {
            b.tick(1, i);
        }
        b.poll();
        assert_eq!(b.seen(), [Seen::Samples(0, 32, 0), Seen::Samples(32, 32, 32)]);
    }

    #[test]
    fn stop_sends_the_rest_and_then_the_final_count() {
        let mut b = bench();
        b.command(Command::Start);
        b.poll();
        (0..40).for_each(|i| b.tick(1, i));
        b.poll();
        b.seen();
        b.command(Command::Stop);
        b.poll();
        let last = Status { samples_sent: 40, ..Status::default() };
        assert_eq!(b.seen(), [Seen::Samples(32, 8, 32), Seen::Status(last)]);
    }

    #[test]
    fn missed_ticks_are_counted_and_leave_a_gap_in_the_index() {
        let mut b = bench();
        b.command(Command::Start);
        b.poll();
        b.seen();
        (0..10).for_each(|i| b.tick(1, i));
        b.tick(4, 10);
        b.sampling.tick(1, || None);
        b.command(Command::Stop);
        b.poll();
        let last = Status { samples_sent: 11, overruns: 4, ..Status::default() };
        assert_eq!(
            b.seen(),
            [Seen::Samples(0, 10, 0), Seen::Samples(13, 1, 10), Seen::Status(last)]
        );
    }

    #[test]
    fn a_held_up_line_drops_samples_and_says_how_many() {
        let mut b = bench();
        b.command(Command::Start);
        b.poll();
        (0..300).for_each(|i| b.tick(1, i));
        assert_eq!(b.sampling.dropped(), 44);
        b.poll();
        b.tick(1, 300);
        b.command(Command::Stop);
        for _ in 0..3 {
            b.seen();
            b.poll();
        }
        assert_eq!(b.stylus.samples_sent(), 257);
    }

    #[test]
    fn light_and_identify_are_obeyed_and_answered_while_damage_is_not() {
        let mut b = bench();
        b.poll();
        b.seen();
        b.to.push(&[9, 9, 0]);
        b.poll();
        assert_eq!(b.seen(), []);
        b.command(Command::LightOn);
        b.poll();
        assert!(b.stylus.light());
        assert_eq!(b.seen(), [Seen::Status(Status { light: true, ..Status::default() })]);
        b.command(Command::LightOff);
        b.command(Command::Identify);
        b.poll();
        assert!(!b.stylus.light());
        assert_eq!(b.seen(), [Seen::Hello, Seen::Status(Status::default())]);
    }

    #[test]
    fn a_start_while_sampling_does_not_restart_the_count() {
        let mut b = bench();
        b.command(Command::Start);
        b.poll();
        (0..32).for_each(|i| b.tick(1, i));
        b.poll();
        b.command(Command::Start);
        b.poll();
        (0..32).for_each(|i| b.tick(1, i));
        b.seen();
        b.poll();
        assert_eq!(b.seen(), [Seen::Samples(32, 32, 0)]);
    }

    #[test]
    fn a_status_comes_once_a_second() {
        let mut b = bench();
        b.command(Command::Start);
        b.poll();
        b.seen();
        let mut statuses = 0;
        for _ in 0..(25_000 / 32) {
            (0..32).for_each(|i| b.tick(1, i));
            b.poll();
            statuses += b.seen().iter().filter(|s| matches!(s, Seen::Status(_))).count();
        }
        assert_eq!(statuses, 2);
    }
}
