//! Addresses of outputs in the configuration.

use std::str::FromStr;

use http::Uri;

/// An address for HTTP POST.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HttpAddress {
    /// The host and the port, by default 80.
    pub host: (String, u16),
    /// The path, with its query.
    pub path: String,
}

/// A topic of an MQTT broker.
#[derive(Clone, PartialEq, Eq)]
pub struct MqttAddress {
    /// The host and the port, by default 1883.
    pub host: (String, u16),
    /// The topic that answers are published under.
    pub topic: String,
    /// User and password, if the broker wants them.
    pub credentials: Option<(String, String)>,
}

impl std::fmt::Debug for MqttAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Never the password.
        write!(f, "MqttAddress({}:{}/{})", self.host.0, self.host.1, self.topic)
    }
}

/// The URI, host and port in an address of this scheme, whose default port is `port`.
fn parts(text: &str, scheme: &str, port: u16) -> Option<(Uri, (String, u16))> {
    let uri: Uri = text.parse().ok()?;
    let host = uri.host().filter(|_| uri.scheme_str() == Some(scheme))?.to_string();
    let port = uri.port_u16().unwrap_or(port);
    let host = host.trim_start_matches('[').trim_end_matches(']').to_string();
    Some((uri, (host, port)))
}

impl FromStr for HttpAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (uri, host) = parts(text, "http", 80).ok_or(
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
        let expected = "expected an address such as \"mqtt://127.0.0.1:1883/surfaced/answers\"";
        let (uri, host) = parts(text, "mqtt", 1883).ok_or(expected)?;
        let topic = uri.path().trim_matches('/').to_string();
        if topic.is_empty() || topic.contains(['#', '+']) {
            return Err(expected.into());
        }
        let user = uri.authority().and_then(|authority| authority.as_str().rsplit_once('@'));
        let credentials = user.map(|(user, _)| {
            let (user, password) = user.split_once(':').unwrap_or((user, ""));
            (user.to_string(), password.to_string())
        });
        Ok(Self { host, topic, credentials })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_taken_apart_and_others_refused() {
        let http: HttpAddress = "http://example:9000/a/b?c=d".parse().unwrap();
        assert_eq!((http.host, http.path.as_str()), (("example".into(), 9000), "/a/b?c=d"));
        assert_eq!("http://[::1]".parse::<HttpAddress>().unwrap().host, ("::1".into(), 80));
        let mqtt: MqttAddress = "mqtt://me:secret@broker/surfaced/answers".parse().unwrap();
        assert_eq!(
            (mqtt.host.clone(), mqtt.topic.as_str()),
            (("broker".into(), 1883), "surfaced/answers")
        );
        assert_eq!(mqtt.credentials, Some(("me".into(), "secret".into())));
        assert!(!format!("{mqtt:?}").contains("secret"));
        for text in ["", "https://x/", "http:///x", "broker/x", "ftp://x"] {
            assert!(text.parse::<HttpAddress>().is_err(), "{text}");
        }
        for text in ["mqtt://broker", "mqtt://broker/", "mqtt://broker/a+", "http://broker/a"] {
            assert!(text.parse::<MqttAddress>().is_err(), "{text}");
        }
    }
}
