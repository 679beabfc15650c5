//! Measures the share of a core that reading lines takes, by TCP, UDP or a pipe, and what is lost.
//!
//! `cargo run --release --example lines_load [SECONDS] [tcp|udp|pipe] [LINES_A_SECOND] [COLUMNS]`
//!
//! By default, 3 columns and a counter by TCP at 10 kHz, each line sent by itself, as by a program that
//! flushes after every line. By UDP, each line is a datagram. Above 50,000 lines a second, lines are
//! sent in blocks by TCP. The measured time is the processor time of the device's own thread: from the
//! socket to the rings.

use std::io::{self, Write};
use std::net::{TcpListener, UdpSocket};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};
use surfaced::device::lines::{Column, Count, Lines, LinesConfig, LinesStream};
use surfaced::device::{Device, DeviceLink};
use surfaced::ring::{Piece, Sink, Stop, Waker, series};
use surfaced::scene::SourceId;

/// Lines a second above which each `write` sends many.
const ONE_BY_ONE: f64 = 50_000.0;
/// The argument by which the program starts itself as the sender of a pipe.
const SENDER: &str = "sender";

#[derive(Clone)]
struct Load {
    seconds: f64,
    kind: String,
    rate_hz: f64,
    columns: usize,
}

impl Load {
    fn of(args: &[String]) -> Result<Self, Box<dyn std::error::Error>> {
        let number =
            |at: usize, default: f64| args.get(at).map_or(Ok(default), |text| text.parse());
        Ok(Self {
            seconds: number(0, 20.0)?,
            kind: args.get(1).map_or("tcp", String::as_str).to_string(),
            rate_hz: number(2, 10_000.0)?,
            columns: number(3, 3.0)? as usize,
        })
    }

    /// Sends lines by `put` at the rate; returns their number.
    fn send(&self, mut put: impl FnMut(&[u8]) -> io::Result<()>) -> io::Result<u64> {
        let names: Vec<String> = (1..=self.columns).map(|column| format!("a{column}")).collect();
        put(format!("n,{}\n", names.join(",")).as_bytes())?;
        let (begin, mut sent, mut text) = (Instant::now(), 0_u64, Vec::new());
        while begin.elapsed().as_secs_f64() < self.seconds {
            let due = (begin.elapsed().as_secs_f64() * self.rate_hz) as u64;
            text.clear();
            while sent < due {
                // Cheap to print, so that the sender is faster than the reader.
                write!(text, "{sent}")?;
                for column in 0..self.columns as u64 {
                    let x = (sent * 7919 + column * 104_729) % 100_000;
                    write!(text, ",0.{x:05}")?;
                }
                text.push(b'\n');
                sent += 1;
                if self.rate_hz <= ONE_BY_ONE || text.len() > 32 * 1024 {
                    put(&text)?;
                    text.clear();
                }
            }
            put(&text)?;
            std::thread::sleep(Duration::from_micros(200));
        }
        Ok(sent)
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args: Vec<String> = std::env::args().skip(1).collect();
    if args.first().is_some_and(|arg| arg == SENDER) {
        args.remove(0);
        let sent = Load::of(&args)?.send(|bytes| io::stdout().write_all(bytes))?;
        eprintln!("{sent} lines sent");
        return Ok(());
    }
    let load = Load::of(&args)?;
    // A pipe ends in standard input, so the program starts itself again behind it.
    if load.kind == "pipe" && std::env::var_os("SURFACED_PIPE").is_none() {
        let program = std::env::current_exe()?;
        let mut sender =
            Command::new(&program).arg(SENDER).args(&args).stdout(Stdio::piped()).spawn()?;
        let from = sender.stdout.take().ok_or("no pipe")?;
        let mut reader = Command::new(&program);
        reader.args(&args).stdin(from).env("SURFACED_PIPE", "1").status()?;
        sender.wait()?;
        return Ok(());
    }
    let own = load.clone();
    let (address, sender) = match load.kind.as_str() {
        "tcp" => {
            let server = TcpListener::bind("127.0.0.1:0")?;
            let address = format!("tcp://{}", server.local_addr()?);
            let send = move || -> io::Result<u64> {
                let (mut line, _) = server.accept()?;
                line.set_nodelay(true)?;
                let sent = own.send(|bytes| line.write_all(bytes))?;
                // Gives the device time to read the last lines.
                std::thread::sleep(Duration::from_millis(300));
                Ok(sent)
            };
            (address, std::thread::spawn(send))
        }
        "udp" => {
            // A port that was free a moment ago.
            let to = UdpSocket::bind("127.0.0.1:0")?.local_addr()?;
            let send = move || -> io::Result<u64> {
                std::thread::sleep(Duration::from_millis(300));
                let socket = UdpSocket::bind("127.0.0.1:0")?;
                let sent = own.send(|bytes| match bytes {
                    [] => Ok(()),
                    bytes => socket.send_to(bytes, to).map(drop),
                })?;
                std::thread::sleep(Duration::from_millis(300));
                Ok(sent)
            };
            (format!("udp://{to}"), std::thread::spawn(send))
        }
        "pipe" => ("-".to_string(), std::thread::spawn(|| Ok(0))),
        other => return Err(format!("{other}: expected tcp, udp or pipe").into()),
    };
    measure(&load, &address, sender)
}

fn measure(
    load: &Load,
    address: &str,
    sender: std::thread::JoinHandle<io::Result<u64>>,
) -> Result<(), Box<dyn std::error::Error>> {
    let columns = (1..=load.columns).map(|column| Column::Name(format!("a{column}"))).collect();
    let stream = LinesStream { id: SourceId::new("ac")?, columns, scale: Some(1.0) };
    let count = Some(Count::Rows(Column::Name("n".into())));
    let (rate_hz, streams) = (Some(load.rate_hz), vec![stream]);
    let config =
        LinesConfig { address: address.parse()?, rate_hz, count, decimal_comma: None, streams };
    let mut device = Lines::new(config);
    let (sink, mut tap) = series(load.columns, load.rate_hz as usize, Waker::new().0);
    let (reports, warnings) = crossbeam_channel::unbounded();
    let stop = Stop::default();
    let link = DeviceLink::new(0, stop.clone(), reports);
    let device = std::thread::spawn(move || {
        let begun = Instant::now();
        let result = device.run(&mut [Sink::Series(sink)], &link);
        let used = clock_gettime(ClockId::ThreadCPUTime);
        let used_s = used.tv_sec as f64 + used.tv_nsec as f64 * 1e-9;
        result.map(|()| (used_s, begun.elapsed().as_secs_f64()))
    });
    let (mut frames, mut missing) = (0_u64, 0_u64);
    let width = load.columns as u64;
    let mut drain = || {
        tap.drain(|piece| match piece {
            Piece::Samples(samples) => frames += samples.len() as u64 / width,
            Piece::Missing(count) => missing += count,
        })
    };
    // By a pipe, the device ends with its input.
    let piped = address == "-";
    while if piped { !device.is_finished() } else { !sender.is_finished() } {
        drain();
        std::thread::sleep(Duration::from_millis(5));
    }
    drain();
    stop.request();
    let sent = sender.join().map_err(|_| "the sender panicked")??;
    let (used_s, took_s) = device.join().map_err(|_| "the device panicked")??;
    drain();
    let sent = if piped { String::new() } else { format!("{sent} lines sent, ") };
    println!(
        "{}: {sent}{frames} received ({:.0} a second), {missing} missing; the device's thread took \
         {:.2} % of a core",
        load.kind,
        frames as f64 / took_s,
        100.0 * used_s / took_s
    );
    for warning in warnings.try_iter() {
        println!("  {:?}", warning.kind);
    }
    Ok(())
}
