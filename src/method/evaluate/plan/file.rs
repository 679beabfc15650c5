//! Reads and writes plans as `plan.toml`.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::library::LibraryError;
use crate::recognise::{MOST_COUNT, MethodName, MethodSpec, ReferenceOptions};
use crate::scene::SourceId;

/// The results to expect from a plan. Shares are fractions from 0 to 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Expected {
    pub target: f64,
    /// Whether `accuracy_whole` reaches the target, and `accuracy` what was wanted at the scan time.
    pub reached: bool,
    /// Whether even the lower end of the accuracy's interval reaches the target.
    pub shown: bool,
    /// Cross-validated accuracy of whole scans; `None` in plans before version 0.4.
    pub accuracy_whole: Option<f64>,
    /// Cross-validated accuracy at the scan time: share of all queries.
    pub accuracy: f64,
    /// Lower end of the accuracy's 95 % Wilson interval.
    pub accuracy_low: f64,
    pub accuracy_high: f64,
    pub queries: usize,
    pub surfaces: usize,
    pub protocol: String,
    /// Median time from raw samples to the answer, in milliseconds, on the machine that made the plan.
    pub latency_ms: f64,
    /// How long a scan lasts, in seconds; 0 if only pictures are compared.
    pub scan_s: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    pub library: String,
    pub synthetic: bool,
    /// The sources to compare; other sources are not needed.
    pub sources: Vec<SourceId>,
    #[serde(flatten)]
    pub method: MethodSpec,
    /// Seconds of the drag that are used; `None` for the whole drag.
    pub scan_s: Option<f64>,
    pub expected: Expected,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlanFile {
    format: u32,
    library: String,
    #[serde(default)]
    synthetic: bool,
    sources: Vec<String>,
    method: MethodName,
    n: Option<usize>,
    repetitions: Option<usize>,
    scan_s: Option<f64>,
    expected: Expected,
}

impl Expected {
    /// A warning if the target is reached, but with too few queries to be sure.
    pub fn doubt(&self) -> Option<String> {
        let (target, low) = (percent(self.target), percent(self.accuracy_low));
        (self.reached && !self.shown).then(|| {
            format!(
                "{target} is not certain: after {} queries, the accuracy may be as low as {low}; \
                 record more trials",
                self.queries
            )
        })
    }
}

impl Plan {
    pub fn read(path: &Path) -> Result<Self, LibraryError> {
        let text = std::fs::read_to_string(path).map_err(|error| LibraryError::io(path, error))?;
        Self::from_toml(&text).map_err(|problem| {
            LibraryError::file(path, format!("{problem}; `surfaced plan` writes such a file"))
        })
    }

    fn from_toml(text: &str) -> Result<Self, String> {
        let file: PlanFile = toml::from_str(text).map_err(|error| error.to_string())?;
        if file.format != 1 {
            return Err(format!("format = {}, but this program reads format 1", file.format));
        }
        if file.sources.is_empty() {
            return Err("sources = []; expected at least one".into());
        }
        let sources: Result<Vec<_>, _> =
            file.sources.iter().map(|name| SourceId::new(name)).collect();
        let sources = sources.map_err(|error| error.to_string())?;
        let counts = 1..=MOST_COUNT;
        let method = match (file.method, file.n, file.repetitions) {
            (MethodName::Reference, Some(samples), Some(repetitions))
                if counts.contains(&samples) && counts.contains(&repetitions) =>
            {
                let usual = ReferenceOptions::default();
                MethodSpec::Reference(ReferenceOptions { samples, repetitions, ..usual })
            }
            (MethodName::Reference, _, _) => {
                return Err(format!(
                    "method = \"reference\" needs n and repetitions, from 1 to {MOST_COUNT}"
                ));
            }
            (_, Some(_), _) | (_, _, Some(_)) => {
                return Err("n and repetitions are for method = \"reference\"; remove them".into());
            }
            (MethodName::Embedding, None, None) => MethodName::Embedding.into(),
            (other, None, None) => {
                let name = other.as_str();
                return Err(format!("method = \"{name}\"; a plan knows reference and embedding"));
            }
        };
        if let Some(x) = file.scan_s.filter(|x| !(x.is_finite() && *x > 0.0)) {
            return Err(format!("scan_s = {x}; expected a positive number of seconds"));
        }
        let PlanFile { library, synthetic, scan_s, expected, .. } = file;
        Ok(Self { library, synthetic, sources, method, scan_s, expected })
    }

    /// The plan as TOML, with comments, in the form that [`Plan::read`] reads.
    pub fn to_toml(&self) -> String {
        let e = &self.expected;
        let quoted = |text: &str| toml::Value::String(text.into()).to_string();
        let sources: Vec<String> = self.sources.iter().map(|id| quoted(id.as_str())).collect();
        let (of, synthetic) = match self.synthetic {
            true => (" of a synthetic scene", "synthetic = true\n"),
            false => ("", ""),
        };
        let [target, accuracy, low, high] =
            [e.target, e.accuracy, e.accuracy_low, e.accuracy_high].map(percent);
        let mut doubt = e.doubt().map_or_else(String::new, |doubt| format!("# {doubt}.\n"));
        if !e.reached {
            doubt = format!("# It does NOT reach its target, {target} of whole scans.\n");
        }
        let scan = match self.scan_s {
            Some(scan_s) => format!("# Seconds of the drag that are used.\nscan_s = {scan_s}"),
            None if e.scan_s > 0.0 => "# No scan_s: the whole drag is used.".into(),
            None => "# No scan_s: nothing of a drag is used.".into(),
        };
        // `Expected` holds only numbers, text and booleans, which TOML can express.
        let expected = toml::to_string(e).expect("plain values");
        format!(
            "# The cheapest setting found for {} surfaces{of}: `surfaced replay --plan` takes it.\n\
             {doubt}format = 1\nlibrary = {}\n{synthetic}\n\
             # Sources to compare; devices for others need not be opened.\n\
             sources = [{}]\nmethod = {}\n{scan}\n\n\
             # By cross-validation inside the library: {accuracy} of {} queries ({low} to {high}).\n\
             [expected]\n{expected}",
            e.surfaces,
            quoted(&self.library),
            sources.join(", "),
            quoted(self.method.name().as_str()),
            e.queries,
        )
    }
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(method: MethodSpec) -> Plan {
        Plan {
            library: "a \"quoted\" name".into(),
            synthetic: true,
            sources: vec![SourceId::new("ca1").unwrap(), SourceId::new("mi2").unwrap()],
            method,
            scan_s: Some(0.5),
            expected: Expected {
                target: 0.99,
                reached: true,
                shown: false,
                accuracy_whole: Some(1.0),
                accuracy: 1.0,
                accuracy_low: 0.84,
                accuracy_high: 1.0,
                queries: 20,
                surfaces: 5,
                protocol: "leave-one-trial-out".into(),
                latency_ms: 1.25,
                scan_s: 0.5,
            },
        }
    }

    #[test]
    fn a_plan_survives_being_written() {
        let mut plan = plan(MethodName::Embedding.into());
        assert_eq!(Plan::from_toml(&plan.to_toml()).unwrap(), plan);
        (plan.scan_s, plan.synthetic) = (None, false);
        plan.expected.reached = false;
        assert_eq!(Plan::from_toml(&plan.to_toml()).unwrap(), plan);
    }

    #[test]
    fn a_plan_of_version_0_2_that_names_reference_is_read() {
        let few = ReferenceOptions { samples: 100, repetitions: 1, ..Default::default() };
        let text = plan(MethodName::Embedding.into()).to_toml();
        let text = text.replace("\"embedding\"", "\"reference\"\nn = 100\nrepetitions = 1");
        assert_eq!(Plan::from_toml(&text).unwrap(), plan(MethodSpec::Reference(few)));
    }

    #[test]
    fn what_cannot_be_is_refused_with_its_place() {
        let good = plan(MethodName::Embedding.into()).to_toml();
        let error = |from: &str, to: &str| Plan::from_toml(&good.replace(from, to)).unwrap_err();
        let unknown = error("format = 1", "format = 1\ncolour = 3");
        assert!(unknown.contains("line 4") && unknown.contains("colour"), "{unknown}");
        assert!(error("format = 1", "format = 2").contains("reads format 1"));
        assert!(error("scan_s = 0.5\n\n", "scan_s = -1\n\n").contains("positive"));
        assert!(error("\"embedding\"", "\"reference\"").contains("needs n"));
        assert!(error("\"embedding\"", "\"embedding\"\nn = 3").contains("reference"));
        assert!(error("[\"ca1\", \"mi2\"]", "[]").contains("at least one"));
        assert!(error("[\"ca1\", \"mi2\"]", "[\"../x\"]").contains("cannot name a source"));
    }
}
