//! Hello messages: the stylus's serial number, firmware and channels.

use crate::{MAX_CHANNELS, MAX_SERIAL, MAX_TEXT};

/// One channel of the stylus. A value v means `v × scale` in `unit`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Channel<'a> {
    /// Name of the measured quantity, at most [`MAX_TEXT`] bytes.
    pub name: &'a str,
    /// Value of one step of the 16-bit samples, in `unit`; finite.
    pub scale: f32,
    /// Unit of the quantity, at most [`MAX_TEXT`] bytes; empty for a plain number.
    pub unit: &'a str,
}

/// A stylus's introduction to the daemon.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hello<'a> {
    /// Serial number of the device, at most [`MAX_SERIAL`] bytes.
    pub serial: &'a str,
    /// Version of the firmware: major, minor, patch.
    pub firmware: [u8; 3],
    /// Samples per second, not zero.
    pub sample_rate_hz: u32,
    /// The channels, in the order of their values in a sample.
    pub channels: ChannelTable<'a>,
}

/// The channels of a [`Hello`]: a slice in a message to send, encoded bytes in a received one.
#[derive(Debug, Clone, Copy)]
pub struct ChannelTable<'a>(Table<'a>);

#[derive(Debug, Clone, Copy)]
enum Table<'a> {
    List(&'a [Channel<'a>]),
    /// Encoded channels; all were checked when the hello was parsed.
    Wire {
        count: usize,
        bytes: &'a [u8],
    },
}

impl<'a> From<&'a [Channel<'a>]> for ChannelTable<'a> {
    fn from(list: &'a [Channel<'a>]) -> Self {
        Self(Table::List(list))
    }
}

impl<'a> ChannelTable<'a> {
    /// Number of channels.
    #[must_use]
    pub fn len(&self) -> usize {
        match self.0 {
            Table::List(list) => list.len(),
            Table::Wire { count, .. } => count,
        }
    }

    /// Whether there are no channels, which no valid message has.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The channels in order.
    pub fn iter(&self) -> impl Iterator<Item = Channel<'a>> + use<'a> {
        let (list, mut wire) = match self.0 {
            Table::List(list) => (list, Cursor(&[])),
            Table::Wire { bytes, .. } => (&[][..], Cursor(bytes)),
        };
        // At most one of `list` and `wire` holds channels; `wire` ends when reading fails.
        list.iter().copied().chain(core::iter::from_fn(move || wire.channel().ok()))
    }
}

impl PartialEq for ChannelTable<'_> {
    fn eq(&self, other: &ChannelTable<'_>) -> bool {
        self.iter().eq(other.iter())
    }
}

/// Reads values one after the other from the body of a hello.
struct Cursor<'a>(&'a [u8]);

impl<'a> Cursor<'a> {
    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], &'static str> {
        let (head, rest) = self.0.split_first_chunk().ok_or("the hello ends too early")?;
        self.0 = rest;
        Ok(*head)
    }

    fn text(&mut self, max: usize) -> Result<&'a str, &'static str> {
        let [len] = self.bytes()?;
        let (text, rest) =
            self.0.split_at_checked(usize::from(len)).ok_or("the hello ends too early")?;
        if text.len() > max {
            return Err("a text in the hello is too long");
        }
        self.0 = rest;
        core::str::from_utf8(text).map_err(|_| "a text in the hello is not UTF-8")
    }

    fn channel(&mut self) -> Result<Channel<'a>, &'static str> {
        let scale = f32::from_le_bytes(self.bytes()?);
        if !scale.is_finite() {
            return Err("a channel's scale is not finite");
        }
        Ok(Channel { scale, name: self.text(MAX_TEXT)?, unit: self.text(MAX_TEXT)? })
    }
}

impl<'a> Hello<'a> {
    pub(crate) fn parse(body: &'a [u8]) -> Result<Self, &'static str> {
        let mut cursor = Cursor(body);
        let firmware = cursor.bytes()?;
        let sample_rate_hz = u32::from_le_bytes(cursor.bytes()?);
        if sample_rate_hz == 0 {
            return Err("the sample rate is zero");
        }
        let serial = cursor.text(MAX_SERIAL)?;
        let [count] = cursor.bytes()?;
        let count = usize::from(count);
        if count == 0 || count > MAX_CHANNELS {
            return Err("a hello has 1 to 16 channels");
        }
        let bytes = cursor.0;
        for _ in 0..count {
            cursor.channel()?;
        }
        if !cursor.0.is_empty() {
            return Err("bytes after the hello's last channel");
        }
        let channels = ChannelTable(Table::Wire { count, bytes });
        Ok(Self { serial, firmware, sample_rate_hz, channels })
    }

    /// Returns the rule that this hello breaks as an error. [`parse`](Self::parse) checks the same.
    pub(crate) fn check(&self) -> Result<(), &'static str> {
        if self.sample_rate_hz == 0 {
            return Err("the sample rate is zero");
        }
        if self.channels.is_empty() || self.channels.len() > MAX_CHANNELS {
            return Err("a hello has 1 to 16 channels");
        }
        let long = |c: Channel<'_>| c.name.len() > MAX_TEXT || c.unit.len() > MAX_TEXT;
        if self.serial.len() > MAX_SERIAL || self.channels.iter().any(long) {
            return Err("a text in the hello is too long");
        }
        if self.channels.iter().any(|c| !c.scale.is_finite()) {
            return Err("a channel's scale is not finite");
        }
        Ok(())
    }
}
