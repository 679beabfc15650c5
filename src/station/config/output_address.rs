//! Addresses of outputs in the configuration.

use std::path::PathBuf;
use std::str::FromStr;

use http::Uri;

/// The first segment of topics if the address of the broker names none.
const PREFIX: &str = "surfaced";

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutputsConfig {
    /// The station's name, included in every answer. It consists of letters, digits, `-` and `_`.
    pub station: String,
    pub http: Option<HttpAddress>,
    pub mqtt: Option<MqttAddress>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HttpAddress {
    /// The host and the port; the default port is 80.
    pub host: (String, u16),
    pub path: String,
}

#[derive(Clone, PartialEq, Eq)]
pub struct MqttAddress {
    /// The host and the port; the default port is 1883, or 8883 with TLS.
    pub host: (String, u16),
    /// The segments with which all topics begin.
    pub prefix: String,
    /// User and password, if the broker requires them.
    pub credentials: Option<(String, String)>,
    /// The files for TLS; `None` if the address does not begin with `mqtts`.
    pub tls: Option<TlsFiles>,
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TlsFiles {
    /// The file of authorities that may sign the broker's certificate; `None` for the system's file.
    pub ca: Option<PathBuf>,
    /// The client's certificate and its key, if the broker requires them.
    pub client: Option<(PathBuf, PathBuf)>,
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
        write!(f, "{scheme}://{}:{}/{}", self.host.0, self.host.1, self.prefix)
    }
}

impl std::fmt::Display for HttpAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "http://{}:{}{}", self.host.0, self.host.1, self.path)
    }
}

/// Whether a text is valid as one segment of a topic on every broker.
pub(crate) fn is_segment(text: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
    (1..=64).contains(&text.len()) && text.chars().all(plain)
}

/// The default name of a station, which is the name of its machine.
pub(crate) fn machine_name() -> String {
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
        let (uri, host) = parts(text, &[("http", 80)]).ok_or(
            "expected an address such as \"http://127.0.0.1:9000/answers\"; for TLS, put a proxy \
             in between",
        )?;
        let path = uri.path_and_query().map_or("/", |path| path.as_str()).to_string();
        Ok(Self { host, path })
    }
}

impl FromStr for MqttAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (uri, host) = parts(text, &[("mqtt", 1883), ("mqtts", 8883)])
            .ok_or("expected an address such as \"mqtt://127.0.0.1:1883\"")?;
        let path = uri.path().trim_matches('/');
        let prefix = if path.is_empty() { PREFIX } else { path }.to_string();
        if !prefix.split('/').all(is_segment) {
            return Err(format!(
                "topics would begin with \"{prefix}\"; use letters, digits, `-` and `_` between \
                 slashes, such as \"mqtt://127.0.0.1:1883/hall-3\""
            ));
        }
        let user = uri.authority().and_then(|authority| authority.as_str().rsplit_once('@'));
        let credentials = user.map(|(user, _)| {
            let (user, password) = user.split_once(':').unwrap_or((user, ""));
            (user.to_string(), password.to_string())
        });
        let tls = (uri.scheme_str() == Some("mqtts")).then(TlsFiles::default);
        Ok(Self { host, prefix, credentials, tls })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_the_machine_is_a_segment_of_a_topic() {
        assert!(is_segment(&machine_name()), "{}", machine_name());
        assert!(!is_segment("") && !is_segment("a b") && !is_segment("a/b") && !is_segment("é"));
    }
}
