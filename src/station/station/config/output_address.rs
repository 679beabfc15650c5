//! Addresses of outputs in the configuration.

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use http::Uri;

use crate::station::AnswerState;

/// The first segment of topics if the address of the broker names none.
const PREFIX: &str = "surfaced";

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutputsConfig {
    /// The station's name, included in every answer. It consists of letters, digits, `-` and `_`.
    pub station: String,
    pub http: Option<HttpAddress>,
    pub mqtt: Option<MqttAddress>,
    pub alerts: Vec<AlertConfig>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HttpAddress {
    /// The host and the port; the default port is 80, or 443 with TLS.
    pub host: (String, u16),
    pub path: String,
    /// The files for TLS; `None` if the address does not begin with `https`.
    pub tls: Option<TlsFiles>,
    /// A file with one header that every request has, such as `Authorization: Bearer SECRET`.
    pub header_file: Option<PathBuf>,
}

#[derive(Clone, PartialEq, Eq)]
pub struct MqttAddress {
    /// The host and the port; the default port is 1883, or 8883 with TLS.
    pub host: (String, u16),
    /// The segments with which all topics begin.
    pub prefix: String,
    /// User and password, if the broker requires them.
    pub credentials: Option<(String, Password)>,
    /// The files for TLS; `None` if the address does not begin with `mqtts`.
    pub tls: Option<TlsFiles>,
}

/// Origin of the password of a broker.
#[derive(Clone, PartialEq, Eq)]
pub enum Password {
    Given(String),
    /// A file that holds the password, and perhaps the end of a line.
    File(PathBuf),
    /// The environment variable `SURFACED_MQTT_PASSWORD`; without it, the password is empty.
    Environment,
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TlsFiles {
    /// The file of authorities that may sign the receiver's certificate; `None` for the system's file.
    pub ca: Option<PathBuf>,
    /// The client's certificate and its key, if the receiver requires them.
    pub client: Option<(PathBuf, PathBuf)>,
}

/// A rule by which answers, or a drift, become an alert.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AlertConfig {
    /// Letters, digits, `-` and `_`; no other rule has it.
    pub name: String,
    pub on: AlertCause,
    /// How many of the last `of` answers must fit; from 1 to `of`. Both are 1 for a drift.
    pub scans: usize,
    pub of: usize,
    /// Time after an alert in which there is no other.
    pub cooldown: Duration,
    /// Address to which the alert is posted, beside its topic.
    pub http: Option<HttpAddress>,
    /// The coil that is on for the time `hold` after an alert.
    pub coil: Option<CoilAddress>,
    pub hold: Duration,
}

/// The event that causes an alert.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AlertCause {
    State(AnswerState),
    /// Answers that name this surface, also those that are not sure.
    Surface(String),
    /// A control chart of a reference surface has left its limits.
    Drift,
}

/// A coil (digital output) of a device that speaks Modbus TCP.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CoilAddress {
    /// The host and the port; the default port is 502.
    pub host: (String, u16),
    pub unit: u8,
    /// Counted from 0.
    pub coil: u16,
}

impl std::fmt::Display for CoilAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { host, unit, coil } = self;
        write!(f, "modbus://{}/{unit}/{coil}", authority(host))
    }
}

impl FromStr for CoilAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let place = |uri: &Uri| {
            let (unit, coil) = uri.path().strip_prefix('/')?.split_once('/')?;
            Some((unit.parse().ok()?, coil.parse().ok()?))
        };
        let found = parts(text, &[("modbus", 502)]);
        let found = found.and_then(|(uri, host)| Some((place(&uri)?, host)));
        let ((unit, coil), host) = found.ok_or(
            "expected host, unit and coil, counted from 0, such as \"modbus://10.0.3.7:502/1/12\"",
        )?;
        Ok(Self { host, unit, coil })
    }
}

impl HttpAddress {
    /// Host and port as a request names them.
    pub fn authority(&self) -> String {
        authority(&self.host)
    }
}

impl MqttAddress {
    /// Takes the password from a file. Returns false if the address has a password, or no user.
    pub fn set_password_file(&mut self, path: PathBuf) -> bool {
        let Some((_, password @ Password::Environment)) = &mut self.credentials else {
            return false;
        };
        *password = Password::File(path);
        true
    }
}

/// The mistake where [`MqttAddress::set_password_file`] returns false.
pub const STRAY_PASSWORD_FILE: &str = "a password file goes with an address that has a user and no password, such as mqtt://USER@HOST";

/// A text with stars in place of each password in an address, for messages that show a line of it.
/// Places in the text stay the same.
pub(crate) fn without_passwords(text: &str) -> String {
    text.split_inclusive('\n').map(|line| starred(line).unwrap_or_else(|| line.into())).collect()
}

fn starred(line: &str) -> Option<String> {
    let begin = line.find("://")? + 3;
    let end = begin + line[begin..].rfind('@')?;
    let begin = begin + line[begin..end].find(':')? + 1;
    Some(format!("{}{}{}", &line[..begin], "*".repeat(end - begin), &line[end..]))
}

impl std::fmt::Debug for MqttAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // The password must not appear in logs.
        write!(f, "MqttAddress({self})")
    }
}

impl std::fmt::Display for MqttAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let scheme = if self.tls.is_some() { "mqtts" } else { "mqtt" };
        write!(f, "{scheme}://{}/{}", authority(&self.host), self.prefix)
    }
}

impl std::fmt::Display for HttpAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let scheme = if self.tls.is_some() { "https" } else { "http" };
        write!(f, "{scheme}://{}{}", self.authority(), self.path)
    }
}

/// Host and port as an address has them, an IPv6 address in brackets.
fn authority((host, port): &(String, u16)) -> String {
    if host.contains(':') { format!("[{host}]:{port}") } else { format!("{host}:{port}") }
}

/// Whether a text is valid as one segment of a topic on every broker.
pub fn is_segment(text: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
    (1..=64).contains(&text.len()) && text.chars().all(plain)
}

/// The default name of a station, which is the name of its machine.
pub fn machine_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname")
        .or_else(|_| std::env::var("COMPUTERNAME"))
        .unwrap_or_default();
    let first = name.trim().split('.').next().unwrap_or_default();
    let plain: String =
        first.chars().map(|c| if is_segment(&c.to_string()) { c } else { '-' }).take(64).collect();
    if plain.is_empty() { "station".into() } else { plain }
}

fn parts(text: &str, schemes: &[(&str, u16)]) -> Option<(Uri, (String, u16))> {
    let uri: Uri = text.parse().ok()?;
    let (_, usual) = schemes.iter().find(|(scheme, _)| uri.scheme_str() == Some(*scheme))?;
    let host = uri.host()?.to_string();
    let port = uri.port_u16().unwrap_or(*usual);
    let host = host.trim_start_matches('[').trim_end_matches(']').to_string();
    Some((uri, (host, port)))
}

impl FromStr for HttpAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (uri, host) = parts(text, &[("http", 80), ("https", 443)])
            .ok_or("expected an address such as \"https://127.0.0.1:9000/answers\"")?;
        let path = uri.path_and_query().map_or("/", |path| path.as_str()).to_string();
        if uri.authority().is_some_and(|authority| authority.as_str().contains('@')) {
            return Err(SECRETS.into());
        }
        let tls = (uri.scheme_str() == Some("https")).then(TlsFiles::default);
        Ok(Self { host, path, tls, header_file: None })
    }
}

impl FromStr for MqttAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (uri, host) = parts(text, &[("mqtt", 1883), ("mqtts", 8883)])
            .ok_or("expected an address such as \"mqtt://127.0.0.1:1883\"")?;
        let path = uri.path().trim_matches('/');
        let prefix = if path.is_empty() { PREFIX } else { path }.to_string();
        if prefix.contains('@') {
            // A slash in the password ended the host too early; the message must not show the rest.
            return Err(ESCAPE.into());
        }
        if !prefix.split('/').all(is_segment) {
            return Err(format!(
                "topics would begin with \"{prefix}\"; use letters, digits, `-` and `_` between \
                 slashes, such as \"mqtt://127.0.0.1:1883/hall-3\""
            ));
        }
        let user = uri.authority().and_then(|authority| authority.as_str().rsplit_once('@'));
        let credentials = user.map(|(user, _)| credentials(user)).transpose()?;
        let tls = (uri.scheme_str() == Some("mqtts")).then(TlsFiles::default);
        Ok(Self { host, prefix, credentials, tls })
    }
}

const SECRETS: &str = "a user and a password in this address are not sent; write them as a header, \
                       `Authorization: Basic …`, into a file, and name it by `header_file`";

/// The mistake where a user or a password holds characters that an address cannot have.
const ESCAPE: &str = "user and password: write % and two hexadecimal digits for a character that has \
                      another meaning there, such as %40 for @, %2F for / and %25 for %";

fn credentials(text: &str) -> Result<(String, Password), String> {
    let plain = |text: &str| percent_decoded(text).ok_or(ESCAPE);
    match text.split_once(':') {
        Some((user, password)) => Ok((plain(user)?, Password::Given(plain(password)?))),
        None => Ok((plain(text)?, Password::Environment)),
    }
}

/// Text with its escapes, `%` and two hexadecimal digits each, decoded; `None` if one is not valid.
pub fn percent_decoded(text: &str) -> Option<String> {
    let mut parts = text.split('%');
    let mut bytes = parts.next()?.as_bytes().to_vec();
    for part in parts {
        let digits = part.get(..2).filter(|two| two.bytes().all(|c| c.is_ascii_hexdigit()))?;
        bytes.push(u8::from_str_radix(digits, 16).ok()?);
        bytes.extend(&part.as_bytes()[2..]);
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_in_user_and_password_are_decoded() {
        let escaped = [("us%40er", "us@er"), ("p%3Ass", "p:ss"), ("%c3%A9%25", "é%"), ("", "")];
        for (text, plain) in escaped {
            assert_eq!(percent_decoded(text).as_deref(), Some(plain));
        }
        for text in ["%", "%4", "a%zz", "%+4", "%ff", "%é"] {
            assert_eq!(percent_decoded(text), None, "{text}");
        }
    }

    #[test]
    fn the_name_of_the_machine_is_a_segment_of_a_topic() {
        assert!(is_segment(&machine_name()), "{}", machine_name());
        assert!(!is_segment("") && !is_segment("a b") && !is_segment("a/b") && !is_segment("é"));
    }
}
