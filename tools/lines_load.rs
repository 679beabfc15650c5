//! Measures the share of a core that reading lines takes (3 channels, 10 kHz, TCP), and their loss.
//!
//! `cargo run --release --example lines_load [SECONDS]`
//!
//! Each line is sent by itself, as by a program that flushes after every line. The measured time is
//! the processor time of the device's own thread: from the socket to the rings.

use std::io::Write;
use std::net::TcpListener;
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};
use surfaced::device::lines::{Column, Count, Lines, LinesConfig, LinesStream};
use surfaced::device::{Device, DeviceLink};
use surfaced::ring::{Piece, Sink, Stop, Waker, series};
use surfaced::scene::SourceId;

const RATE_HZ: u64 = 10_000;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let seconds: f64 = std::env::args().nth(1).map_or(Ok(20.0), |text| text.parse())?;
    let server = TcpListener::bind("127.0.0.1:0")?;
    let address = format!("tcp://{}", server.local_addr()?).parse()?;
    let sender = std::thread::spawn(move || -> std::io::Result<u64> {
        let (mut line, _) = server.accept()?;
        line.set_nodelay(true)?;
        line.write_all(b"n,ax,ay,az\n")?;
        let (begin, mut sent) = (Instant::now(), 0_u64);
        while begin.elapsed().as_secs_f64() < seconds {
            let due = (begin.elapsed().as_secs_f64() * RATE_HZ as f64) as u64;
            while sent < due {
                let x = (sent as f64 * 0.1).sin();
                writeln!(line, "{sent},{x:.5},{:.5},{:.5}", 0.5 * x, x - 1.0)?;
                sent += 1;
            }
            std::thread::sleep(Duration::from_micros(200));
        }
        // Gives the device time to read the last lines.
        std::thread::sleep(Duration::from_millis(300));
        Ok(sent)
    });

    let columns = ["ax", "ay", "az"].map(|name| Column::Name(name.into())).to_vec();
    let stream = LinesStream { id: SourceId::new("ac")?, columns, scale: Some(1.0) };
    let count = Some(Count::Rows(Column::Name("n".into())));
    let (rate_hz, streams) = (Some(RATE_HZ as f64), vec![stream]);
    let mut device = Lines::new(LinesConfig { address, rate_hz, count, decimal_comma: None, streams });
    let (sink, mut tap) = series(3, RATE_HZ as usize, Waker::new().0);
    let (reports, warnings) = crossbeam_channel::unbounded();
    let stop = Stop::default();
    let link = DeviceLink::new(0, stop.clone(), reports);
    let device = std::thread::spawn(move || {
        let begun = Instant::now();
        let result = device.run(&mut [Sink::Series(sink)], &link);
        let used = clock_gettime(ClockId::ThreadCPUTime);
        let used_s = used.tv_sec as f64 + used.tv_nsec as f64 * 1e-9;
        result.map(|()| used_s / begun.elapsed().as_secs_f64())
    });

    let (mut frames, mut missing) = (0_u64, 0_u64);
    let mut drain = || {
        tap.drain(|piece| match piece {
            Piece::Samples(samples) => frames += samples.len() as u64 / 3,
            Piece::Missing(count) => missing += count,
        })
    };
    while !sender.is_finished() {
        drain();
        std::thread::sleep(Duration::from_millis(5));
    }
    drain();
    stop.request();
    let sent = sender.join().map_err(|_| "the sender panicked")??;
    let share = device.join().map_err(|_| "the device panicked")??;
    drain();
    println!(
        "{sent} lines sent, {frames} received, {missing} missing; the device's thread took {:.2} % of \
         a core",
        100.0 * share
    );
    for warning in warnings.try_iter() {
        println!("  {:?}", warning.kind);
    }
    Ok(())
}
