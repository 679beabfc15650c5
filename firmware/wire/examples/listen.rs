//! Commands a stylus on the line (a pty or a serial device in raw mode) and counts what comes,
//! until its final status: prints one JSON document.
//!
//! `listen PATH [SECONDS]`; gives up after so many seconds without the end (default 120).

use std::fs::OpenOptions;
use std::io::{Read, Write};
use std::time::{Duration, Instant};

use surfaced_wire::{Command, Decoder, MAX_ENCODED, Message, encode};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let path = args.next().ok_or("usage: listen PATH [SECONDS]")?;
    let limit = Duration::from_secs(args.next().map_or(Ok(120), |s| s.parse())?);
    let mut line = OpenOptions::new().read(true).write(true).open(path)?;
    let mut writer = line.try_clone()?;
    let mut out = [0; MAX_ENCODED];
    let mut command = |command| -> std::io::Result<()> {
        let n = encode(&Message::Command(command), &mut out).map_err(std::io::Error::other)?;
        writer.write_all(&out[..n])
    };
    command(Command::Identify)?;
    command(Command::LightOn)?;
    command(Command::Start)?;
    let (mut hellos, mut light, mut damaged) = (0u32, false, 0u64);
    let (mut samples, mut messages, mut missing, mut next) = (0u64, 0u64, 0u64, 0u64);
    let mut decoder = Decoder::new();
    let mut bytes = [0; 4096];
    let (begin, mut last) = (Instant::now(), None);
    let mut was_sampling = false;
    'line: while begin.elapsed() < limit {
        let n = match line.read(&mut bytes) {
            Ok(0) | Err(_) => break, // hung up
            Ok(n) => n,
        };
        let mut input = &bytes[..n];
        while let Some(result) = decoder.next(&mut input) {
            match result {
                Ok(Message::Hello(_)) => hellos += 1,
                Ok(Message::Samples(s)) => {
                    missing += s.first_index().saturating_sub(next);
                    next = s.next_index();
                    samples += s.count() as u64;
                    messages += 1;
                    was_sampling = true;
                }
                Ok(Message::Status(s)) => {
                    light |= s.light;
                    if was_sampling && !s.sampling {
                        last = Some(s);
                        break 'line;
                    }
                }
                Ok(Message::Command(_)) => {}
                Err(_) => damaged += 1,
            }
        }
    }
    let told = last.map_or("null".to_owned(), |s| s.samples_sent.to_string());
    println!(
        "{{\"frames_received\":{samples},\"messages_received\":{messages},\"missing\":{missing},\
         \"damaged\":{damaged},\"hellos\":{hellos},\"light_answered\":{light},\
         \"status_samples_sent\":{told},\"seconds\":{:.2}}}",
        begin.elapsed().as_secs_f64()
    );
    Ok(())
}
