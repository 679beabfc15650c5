//! The sources of text lines: serial ports, TCP or UDP addresses, standard input.

use std::cell::Cell;
use std::collections::VecDeque;
use std::io::{self, Read};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs, UdpSocket};
use std::rc::Rc;
use std::str::FromStr;
use std::sync::Mutex;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError};
use socket2::{SockRef, TcpKeepalive};

use crate::device::OpenError;
use crate::device::serial::{Selector, WAIT};
use crate::device::system;

/// Default rate of a microcontroller's serial port, in baud.
const BAUD: u32 = 115_200;
const CONNECT: Duration = Duration::from_secs(1);
/// Silence of a TCP connection after which the other end is asked whether it is there, and the time
/// between two such questions. After some ten without an answer, the connection is lost.
const KEEPALIVE: [Duration; 2] = [Duration::from_secs(3), Duration::from_secs(1)];
/// Length in bytes of the buffer for a datagram; no datagram is longer.
const DATAGRAM: usize = 64 * 1024;

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinesAddress {
    Serial(Selector, u32),
    /// `HOST:PORT` of a program that accepts TCP connections and sends lines to each client.
    Tcp(String),
    /// `HOST:PORT` of this machine, at which UDP datagrams arrive; each holds whole lines.
    Udp(String),
    Stdin,
}

impl FromStr for LinesAddress {
    type Err = String;

    /// Parses a serial port (`PORT` or `PORT@BAUD`), `tcp://HOST:PORT`, `udp://HOST:PORT`, or `-`.
    fn from_str(text: &str) -> Result<Self, String> {
        let expected = "expected a serial port (`/dev/ttyACM0`, `COM3`, `usb:2341:0043`, with \
                        `@9600` for another rate than 115200 baud), `tcp://HOST:PORT`, \
                        `udp://HOST:PORT`, or `-` for standard input";
        let host = |rest: &str| {
            let (host, port) = rest.rsplit_once(':')?;
            (!host.is_empty() && port.parse::<u16>().is_ok()).then(|| rest.to_string())
        };
        let found = match text.split_once("://") {
            Some(("tcp", rest)) => host(rest).map(Self::Tcp),
            Some(("udp", rest)) => host(rest).map(Self::Udp),
            Some(_) => None,
            None if text == "-" => Some(Self::Stdin),
            None => {
                let rated = text.rsplit_once('@').map(|(port, baud)| (port, baud.parse()));
                let (port, baud) = rated.unwrap_or((text, Ok(BAUD)));
                match (port.parse(), baud) {
                    // `auto` is refused: it selects the stylus's chip, which prints no lines.
                    (Ok(port), Ok(baud @ 1..)) if port != Selector::Auto => {
                        Some(Self::Serial(port, baud))
                    }
                    _ => None,
                }
            }
        };
        found.ok_or_else(|| format!("`{text}` is not a place that lines come from; {expected}"))
    }
}

impl std::fmt::Display for LinesAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Serial(Selector::Path(path), BAUD) => write!(f, "{}", path.display()),
            Self::Serial(port, baud) => write!(f, "{port}@{baud}"),
            Self::Tcp(host) => write!(f, "tcp://{host}"),
            Self::Udp(host) => write!(f, "udp://{host}"),
            Self::Stdin => f.write_str("-"),
        }
    }
}

impl LinesAddress {
    /// Whether the first bytes may begin in the middle of a line.
    pub fn begins_half(&self) -> bool {
        matches!(self, Self::Serial(..) | Self::Tcp(_))
    }

    /// The message for bytes that hold no numbers: says what is wrong, and what to check.
    pub fn no_numbers(&self) -> String {
        let check = match self {
            Self::Serial(..) => "its rate in baud (as in PORT@9600), and what it prints",
            _ => "what the program there sends",
        };
        format!("no lines of numbers come; check {check}")
    }

    /// Opens the address. A read times out after a moment.
    pub fn open(&self) -> Result<OpenLine, OpenError> {
        let (mut drops, mut mixed) = (None, Mixed::default());
        let line: Box<dyn Read> = match self {
            Self::Serial(port, baud) => {
                let (port, path) = port.open_at(*baud)?;
                return Ok(OpenLine { line: port as Box<dyn Read>, path, drops, mixed });
            }
            Self::Tcp(host) => Box::new(connect(host).map_err(|error| {
                let what = "start the program that sends there, or correct the address";
                OpenError::Failed(format!("tcp://{host}: {error}; {what}"))
            })?),
            Self::Udp(host) => {
                let datagrams = listen(host).map_err(|error| {
                    let what = "name an address of this machine whose port is free, such as \
                                udp://0.0.0.0:5005";
                    OpenError::Failed(format!("udp://{host}: {error}; {what}"))
                })?;
                drops = Drops::of(&datagrams.socket);
                mixed = datagrams.mixed.clone();
                Box::new(datagrams)
            }
            Self::Stdin => Box::new(StandardInput),
        };
        Ok(OpenLine { line, path: self.to_string(), drops, mixed })
    }
}

pub struct OpenLine {
    pub line: Box<dyn Read>,
    /// The name of the opened line, such as the path of a serial port.
    pub path: String,
    /// `None` where nobody counts what is dropped before it is read.
    pub drops: Option<Drops>,
    pub mixed: Mixed,
}

/// Two senders whose datagrams come to one port by turns, once there are two.
pub(super) type Mixed = Rc<Cell<Option<[SocketAddr; 2]>>>;

/// The number of datagrams that the system has dropped at a socket, since nobody read them in time.
pub struct Drops {
    socket: UdpSocket,
    seen: u64,
}

impl Drops {
    fn of(socket: &UdpSocket) -> Option<Self> {
        let seen = system::datagrams_dropped(socket)?;
        Some(Self { socket: socket.try_clone().ok()?, seen })
    }

    /// The number of datagrams that were dropped since the last call.
    pub(super) fn fresh(&mut self) -> u64 {
        let now = system::datagrams_dropped(&self.socket).unwrap_or(self.seen);
        now.saturating_sub(std::mem::replace(&mut self.seen, now))
    }
}

fn connect(host: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::new(io::ErrorKind::NotFound, "it has no address");
    for address in host.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, CONNECT) {
            Ok(stream) => {
                stream.set_read_timeout(Some(WAIT))?;
                // A device that loses its power ends no connection.
                let [time, interval] = KEEPALIVE;
                let keepalive = TcpKeepalive::new().with_time(time).with_interval(interval);
                SockRef::from(&stream).set_tcp_keepalive(&keepalive)?;
                return Ok(stream);
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// Reads datagrams as one text. A datagram's last line ends with the datagram.
struct Datagrams {
    socket: UdpSocket,
    /// The latest datagram and its line end, of which `kept` bytes are not read yet.
    datagram: Vec<u8>,
    kept: usize,
    /// The sender of the latest datagram, and the sender before that one.
    senders: [Option<SocketAddr>; 2],
    mixed: Mixed,
}

fn listen(host: &str) -> io::Result<Datagrams> {
    let socket = UdpSocket::bind(host)?;
    socket.set_read_timeout(Some(WAIT))?;
    let (datagram, senders, mixed) = (vec![0; DATAGRAM + 1], [None; 2], Mixed::default());
    Ok(Datagrams { socket, datagram, kept: 0, senders, mixed })
}

impl Datagrams {
    fn receive(&mut self) -> io::Result<()> {
        let (n, from) = self.socket.recv_from(&mut self.datagram[..DATAGRAM])?;
        self.note(from);
        self.datagram[n] = b'\n';
        self.kept = n + 1;
        Ok(())
    }

    /// A sender may get another port, as by a restart, but then its first port does not come again.
    fn note(&mut self, from: SocketAddr) {
        let [last, before] = self.senders;
        if last != Some(from) {
            if let (Some(last), true) = (last, before == Some(from)) {
                self.mixed.set(Some([from, last]));
            }
            self.senders = [Some(from), last];
        }
    }
}

impl Read for Datagrams {
    /// Waits for a datagram, and takes all that have arrived. The buffer must hold the longest
    /// datagram and one more byte, like the driver's buffer.
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.kept == 0 {
            self.receive()?;
        }
        self.socket.set_nonblocking(true)?;
        let mut n = 0;
        while n + self.kept <= buffer.len() {
            buffer[n..n + self.kept].copy_from_slice(&self.datagram[..self.kept]);
            n += std::mem::take(&mut self.kept);
            // If none has arrived, or receiving fails, the next read says so.
            if self.receive().is_err() {
                break;
            }
        }
        self.socket.set_nonblocking(false)?;
        Ok(n)
    }
}

/// The only reader of standard input. Bytes that a survey has put back are read again.
static STDIN: Mutex<StdinReader> = Mutex::new(StdinReader { blocks: None, first: VecDeque::new() });

/// Reads standard input on its own thread, since nothing can interrupt a read. The channel holds
/// few blocks, so a program that writes too fast has to wait.
struct StdinReader {
    /// The blocks that the thread has read; `None` before the first read.
    blocks: Option<Receiver<Vec<u8>>>,
    /// Bytes to read before the next block.
    first: VecDeque<u8>,
}

fn start_reader() -> io::Result<Receiver<Vec<u8>>> {
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
    Ok(blocks)
}

/// Standard input. All values of this type share it.
struct StandardInput;

/// Puts back bytes of standard input, so that the next reads return these bytes first.
pub(super) fn put_back(mut bytes: Vec<u8>) {
    if let Ok(mut reader) = STDIN.lock() {
        bytes.extend(reader.first.drain(..));
        reader.first = bytes.into();
    }
}

impl Read for StandardInput {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let mut reader = STDIN.lock().map_err(|_| io::Error::other("its reader panicked"))?;
        let StdinReader { blocks, first } = &mut *reader;
        if first.is_empty() {
            let blocks = match blocks {
                Some(blocks) => blocks,
                None => blocks.insert(start_reader()?),
            };
            *first = match blocks.recv_timeout(WAIT) {
                Ok(block) => block.into(),
                Err(RecvTimeoutError::Timeout) => return Err(io::ErrorKind::TimedOut.into()),
                Err(RecvTimeoutError::Disconnected) => return Ok(0),
            };
        }
        first.read(buffer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_datagram_ends_its_line() {
        let mut port = listen("127.0.0.1:0").unwrap();
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        let to = port.socket.local_addr().unwrap();
        sender.send_to(b"1,2", to).unwrap();
        sender.send_to(b"3,4\n", to).unwrap();
        // One read may take several datagrams.
        let (mut text, mut buffer) = (Vec::new(), vec![0; DATAGRAM + 1]);
        while text.len() < 9 {
            let n = port.read(&mut buffer).unwrap();
            text.extend_from_slice(&buffer[..n]);
        }
        assert_eq!(text, b"1,2\n3,4\n\n");
    }

    #[test]
    fn two_senders_at_one_port_are_seen_and_one_with_a_new_port_is_not() {
        let mut port = listen("127.0.0.1:0").unwrap();
        let [one, two, three] = [1, 2, 3].map(|port| SocketAddr::from(([127, 0, 0, 1], port)));
        [one, one, two, two, three].into_iter().for_each(|from| port.note(from));
        assert_eq!(port.mixed.get(), None);
        port.note(two);
        assert_eq!(port.mixed.get(), Some([two, three]));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn what_the_system_drops_is_counted() {
        let mut port = listen("127.0.0.1:0").unwrap();
        let mut drops = Drops::of(&port.socket).unwrap();
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        let to = port.socket.local_addr().unwrap();
        // More than fits into the buffer of a socket.
        let sent = 20_000;
        for _ in 0..sent {
            sender.send_to(b"1,2", to).unwrap();
        }
        let (mut text, mut buffer) = (Vec::new(), vec![0; DATAGRAM + 1]);
        while let Ok(n) = port.read(&mut buffer) {
            text.extend_from_slice(&buffer[..n]);
        }
        let dropped = drops.fresh();
        assert!(dropped > 0);
        assert_eq!(text.len() as u64 / 4 + dropped, sent);
        assert_eq!(drops.fresh(), 0);
    }

    #[test]
    fn a_connection_is_kept_alive() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let stream = connect(&listener.local_addr().unwrap().to_string()).unwrap();
        assert!(SockRef::from(&stream).keepalive().unwrap());
    }

    #[test]
    fn nobody_there_is_said_with_what_to_do() {
        // Nothing listens at this port, which was free a moment ago.
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let error = LinesAddress::Tcp(free.to_string()).open().err().unwrap().to_string();
        assert!(error.contains("start the program"), "{error}");
    }
}
