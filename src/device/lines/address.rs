//! The places that lines come from: a serial port, a TCP or UDP address, standard input.

use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs, UdpSocket};
use std::str::FromStr;
use std::sync::Mutex;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError};

use crate::device::OpenError;
use crate::device::serial::{OpenPort, Port, Selector, WAIT};

/// The usual rate of a microcontroller's port.
const BAUD: u32 = 115_200;
/// The time that a connection may take.
const CONNECT: Duration = Duration::from_secs(1);
/// Longer than any datagram.
const DATAGRAM: usize = 64 * 1024;

/// The place that lines come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinesAddress {
    /// A serial port at a number of baud.
    Serial(Selector, u32),
    /// `HOST:PORT` of a program that sends lines to those who connect.
    Tcp(String),
    /// `HOST:PORT` on which datagrams come, each of whole lines.
    Udp(String),
    Stdin,
}

impl FromStr for LinesAddress {
    type Err = String;

    /// A serial port as `PORT` or `PORT@BAUD`, `tcp://HOST:PORT`, `udp://HOST:PORT`, or `-`.
    fn from_str(text: &str) -> Result<Self, String> {
        let expected = "expected a serial port (`/dev/ttyACM0`, `COM3`, `usb:2341:0043`, with \
                        `@9600` for another rate than 115200 baud), `tcp://HOST:PORT`, \
                        `udp://HOST:PORT`, or `-` for standard input";
        let refused = || Err(format!("`{text}` is not a place that lines come from; {expected}"));
        let host = |rest: &str| {
            let (host, port) = rest.rsplit_once(':')?;
            (!host.is_empty() && port.parse::<u16>().is_ok()).then(|| rest.to_string())
        };
        match text.split_once("://") {
            Some(("tcp", rest)) => host(rest).map_or_else(refused, |host| Ok(Self::Tcp(host))),
            Some(("udp", rest)) => host(rest).map_or_else(refused, |host| Ok(Self::Udp(host))),
            Some(_) => refused(),
            None if text == "-" => Ok(Self::Stdin),
            None => {
                let (port, baud) = match text.rsplit_once('@').map(|(p, baud)| (p, baud.parse())) {
                    Some((port, Ok(1..))) => (port, text[port.len() + 1..].parse()),
                    Some(_) => return refused(),
                    None => (text, Ok(BAUD)),
                };
                match (port.parse(), baud) {
                    // That is the stylus's own chip.
                    (Ok(Selector::Auto) | Err(_), _) | (_, Err(_)) => refused(),
                    (Ok(port), Ok(baud)) => Ok(Self::Serial(port, baud)),
                }
            }
        }
    }
}

impl std::fmt::Display for LinesAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Serial(Selector::Usb { vendor, product, serial }, baud) => {
                write!(f, "usb:{vendor:04x}:{product:04x}")?;
                serial.iter().try_for_each(|serial| write!(f, ":{serial}"))?;
                write!(f, "@{baud}")
            }
            Self::Serial(port, BAUD) => write!(f, "{port}"),
            Self::Serial(port, baud) => write!(f, "{port}@{baud}"),
            Self::Tcp(host) => write!(f, "tcp://{host}"),
            Self::Udp(host) => write!(f, "udp://{host}"),
            Self::Stdin => f.write_str("-"),
        }
    }
}

impl LinesAddress {
    /// Whether what comes first may begin within a line.
    pub fn begins_half(&self) -> bool {
        matches!(self, Self::Serial(..) | Self::Tcp(_))
    }

    /// What to do where bytes come, but no lines of numbers.
    pub fn garbage_hint(&self) -> &'static str {
        match self {
            Self::Serial(..) => "check its rate in baud (as in PORT@9600), and what it prints",
            _ => "check what the program there sends",
        }
    }
}

impl OpenPort for LinesAddress {
    fn name(&self) -> String {
        match self {
            Self::Stdin => "lines from standard input".into(),
            other => format!("lines from {other}"),
        }
    }

    fn open(&mut self) -> Result<(Box<dyn Port>, String), OpenError> {
        let port: Box<dyn Port> = match self {
            Self::Serial(port, baud) => return port.open_at(*baud),
            Self::Tcp(host) => Box::new(connect(host).map_err(|error| {
                let what = "start the program that sends there, or correct the address";
                OpenError::Failed(format!("tcp://{host}: {error}; {what}"))
            })?),
            Self::Udp(host) => Box::new(listen(host).map_err(|error| {
                let what = "name an address of this machine whose port is free, such as \
                            udp://0.0.0.0:5005";
                OpenError::Failed(format!("udp://{host}: {error}; {what}"))
            })?),
            Self::Stdin => Box::new(StandardInput),
        };
        Ok((port, self.to_string()))
    }
}

fn connect(host: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::new(io::ErrorKind::NotFound, "it has no address");
    for address in host.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, CONNECT) {
            Ok(stream) => {
                stream.set_read_timeout(Some(WAIT))?;
                return Ok(stream);
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// Datagrams as one text; the end of each ends its last line.
struct Datagrams {
    socket: UdpSocket,
    datagram: Vec<u8>,
}

fn listen(host: &str) -> io::Result<Datagrams> {
    let socket = UdpSocket::bind(host)?;
    socket.set_read_timeout(Some(WAIT))?;
    Ok(Datagrams { socket, datagram: vec![0; DATAGRAM + 1] })
}

impl Read for Datagrams {
    /// The buffer must hold the longest datagram and a byte, as the driver's does.
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n = self.socket.recv(&mut self.datagram[..DATAGRAM])?;
        self.datagram[n] = b'\n';
        let n = (n + 1).min(buffer.len());
        buffer[..n].copy_from_slice(&self.datagram[..n]);
        Ok(n)
    }
}

impl Write for Datagrams {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Standard input is there once, and what was read of it to learn what comes is played again.
static STDIN: Mutex<Option<StdinReader>> = Mutex::new(None);

/// Reads on a thread of its own, since a read cannot be ended; blocks wait for their reader, so
/// that a program that writes waits too.
struct StdinReader {
    blocks: Receiver<Vec<u8>>,
    /// Bytes that come first.
    first: Vec<u8>,
}

impl StdinReader {
    fn start() -> io::Result<Self> {
        let (send, blocks) = crossbeam_channel::bounded(4);
        let read = move || {
            let mut buffer = [0; 16 * 1024];
            while let Ok(n @ 1..) = io::stdin().read(&mut buffer) {
                if send.send(buffer[..n].to_vec()).is_err() {
                    return;
                }
            }
        };
        std::thread::Builder::new().name("stdin".into()).spawn(read)?;
        Ok(Self { blocks, first: Vec::new() })
    }
}

/// Standard input; clones read the same one.
pub struct StandardInput;

impl StandardInput {
    /// Puts bytes that were read back before all others.
    pub fn put_back(bytes: Vec<u8>) {
        if let Ok(mut stdin) = STDIN.lock()
            && let Some(reader) = stdin.as_mut()
        {
            let rest = std::mem::replace(&mut reader.first, bytes);
            reader.first.extend(rest);
        }
    }
}

impl Read for StandardInput {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let mut stdin = STDIN.lock().map_err(|_| io::Error::other("its reader panicked"))?;
        if stdin.is_none() {
            *stdin = Some(StdinReader::start()?);
        }
        // Set above.
        let Some(reader) = stdin.as_mut() else { return Ok(0) };
        if reader.first.is_empty() {
            reader.first = match reader.blocks.recv_timeout(WAIT) {
                Ok(block) => block,
                Err(RecvTimeoutError::Timeout) => return Err(io::ErrorKind::TimedOut.into()),
                Err(RecvTimeoutError::Disconnected) => return Ok(0),
            };
        }
        let n = reader.first.len().min(buffer.len());
        buffer[..n].copy_from_slice(&reader.first[..n]);
        reader.first.drain(..n);
        Ok(n)
    }
}

impl Write for StandardInput {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_a_port_a_host_or_standard_input() {
        for text in ["/dev/ttyACM0", "COM3@9600", "usb:2341:0043@115200", "tcp://robot:5000", "-"] {
            assert_eq!(text.parse::<LinesAddress>().unwrap().to_string(), text);
        }
        let path = |port: &str| Selector::Path(port.into());
        assert_eq!("COM3@9600".parse(), Ok(LinesAddress::Serial(path("COM3"), 9600)));
        assert_eq!("udp://[::]:5000".parse(), Ok(LinesAddress::Udp("[::]:5000".into())));
        for text in ["", "auto", "tcp://robot", "http://a:1", "udp://:x", "COM3@fast", "COM3@0"] {
            let refused = text.parse::<LinesAddress>().unwrap_err();
            assert!(refused.contains("tcp://HOST:PORT"), "{text}: {refused}");
        }
    }

    #[test]
    fn a_datagram_ends_its_line() {
        let mut port = listen("127.0.0.1:0").unwrap();
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        let to = port.socket.local_addr().unwrap();
        sender.send_to(b"1,2", to).unwrap();
        sender.send_to(b"3,4\n", to).unwrap();
        let (mut text, mut buffer) = (Vec::new(), vec![0; DATAGRAM + 1]);
        while text.len() < 9 {
            let n = port.read(&mut buffer).unwrap();
            text.extend_from_slice(&buffer[..n]);
        }
        assert_eq!(text, b"1,2\n3,4\n\n");
    }

    #[test]
    fn nobody_there_is_said_with_what_to_do() {
        // A port that was free a moment ago.
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let error = LinesAddress::Tcp(free.to_string()).open().err().unwrap().to_string();
        assert!(error.contains("start the program"), "{error}");
    }
}
