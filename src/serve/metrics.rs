//! Metrics for Prometheus, in its text format 0.0.4.
//!
//! <https://prometheus.io/docs/instrumenting/exposition_formats/>: a few lines of text for each
//! metric, written here without a registry, since the meters of the rings keep the counts.

use std::fmt::{Display, Write};
use std::sync::atomic::{AtomicU64, Ordering};

use super::guard::Traffic;
use super::state::State;
use crate::device::DeviceState;
use crate::history::Precision;
use crate::outputs::OutputView;
use crate::printable::Printable;
use crate::scan::StreamMeter;
use crate::station::AnswerState;

/// The content type of the format.
pub const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Bounds of the histogram of scan durations, in seconds.
const SCAN_S: [f64; 8] = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 60.0];
/// Bounds of the histogram of latencies, in seconds.
const LATENCY_S: [f64; 11] = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5];

/// A histogram: counts of values between bounds.
#[derive(Debug)]
struct Histogram {
    bounds: &'static [f64],
    /// For each bound, the values up to it and above the one before; then those above all bounds.
    counts: Vec<u64>,
    sum: f64,
}

impl Histogram {
    fn new(bounds: &'static [f64]) -> Self {
        Self { bounds, counts: vec![0; bounds.len() + 1], sum: 0.0 }
    }

    fn observe(&mut self, value: f64) {
        let at = self.bounds.iter().position(|&bound| value <= bound);
        self.counts[at.unwrap_or(self.bounds.len())] += 1;
        self.sum += value;
    }
}

/// Numbers that are counted here.
#[derive(Debug)]
pub struct Metrics {
    scan_s: Histogram,
    latency_s: Histogram,
}

impl Default for Metrics {
    fn default() -> Self {
        let (scan_s, latency_s) = (Histogram::new(&SCAN_S), Histogram::new(&LATENCY_S));
        Self { scan_s, latency_s }
    }
}

/// Numbers that are counted elsewhere.
pub struct Elsewhere<'a> {
    pub state: &'a State,
    pub meters: &'a [StreamMeter],
    pub traffic: &'a Traffic,
    pub subscribers: usize,
    pub dropped_events: u64,
    pub missed_notices: u64,
    /// The outputs that answers go to.
    pub outputs: &'a [OutputView],
    /// How many answers were right, of those that somebody reviewed.
    pub precision: &'a [Precision],
}

impl Metrics {
    /// Counts a scan that was named.
    pub fn scan(&mut self, scan_s: f64, latency_s: f64) {
        self.scan_s.observe(scan_s);
        self.latency_s.observe(latency_s);
    }

    /// The text of all metrics.
    pub fn text(&self, elsewhere: &Elsewhere<'_>) -> String {
        let mut page = MetricsPage::default();
        let state = elsewhere.state;
        page.head("surfaced_info", "gauge", "The version of the program.");
        page.line("surfaced_info", &[("version", state.version)], 1);
        page.streams(elsewhere.meters);
        page.devices(state);
        let (counts, traffic) = (state.counts, elsewhere.traffic);
        let count = |of: &AtomicU64| of.load(Ordering::Relaxed);
        page.head("surfaced_scans_total", "counter", "Scans that were answered.");
        let others = counts.nearest + counts.unsure + counts.unknown;
        for (state, count) in [
            (AnswerState::Named, counts.scans - others),
            (AnswerState::Nearest, counts.nearest),
            (AnswerState::Unsure, counts.unsure),
            (AnswerState::Unknown, counts.unknown),
            (AnswerState::Unnamed, counts.unnamed),
        ] {
            page.line("surfaced_scans_total", &[("answer", state.as_str())], count);
        }
        for (name, help, value) in [
            ("surfaced_scans_spoiled_total", "Scans that should not be trusted.", counts.spoiled),
            ("surfaced_scans_enrolled_total", "Scans kept for the library.", counts.enrolled),
            ("surfaced_warnings_total", "Warnings.", counts.warnings),
            ("surfaced_http_requests_total", "Requests that were read.", count(&traffic.requests)),
            (
                "surfaced_http_refused_total",
                "Requests and connections refused.",
                count(&traffic.refused),
            ),
            (
                "surfaced_events_dropped_total",
                "Events that a slow subscriber missed.",
                elsewhere.dropped_events,
            ),
            (
                "surfaced_notices_missed_total",
                "Notices that the server missed.",
                elsewhere.missed_notices,
            ),
        ] {
            page.head(name, "counter", help);
            page.line(name, &[], value);
        }
        page.outputs(elsewhere.outputs);
        page.precision(elsewhere.precision);
        page.head("surfaced_readers", "gauge", "Subscribers to the stream of events.");
        page.line("surfaced_readers", &[], elsewhere.subscribers);
        page.histogram("surfaced_scan_seconds", "Duration of a scan.", &self.scan_s);
        let help = "From the end of a scan to its name.";
        page.histogram("surfaced_answer_latency_seconds", help, &self.latency_s);
        page.0
    }
}

#[derive(Default)]
struct MetricsPage(String);

impl MetricsPage {
    // Writing to a string cannot fail.
    fn head(&mut self, name: &str, kind: &str, help: &str) {
        let _ = writeln!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}");
    }

    fn line(&mut self, name: &str, labels: &[(&str, &str)], value: impl Display) {
        self.0.push_str(name);
        for (at, (label, text)) in labels.iter().enumerate() {
            let text = Printable(text).to_string();
            let text = text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
            let _ = write!(self.0, "{}{label}=\"{text}\"", if at == 0 { '{' } else { ',' });
        }
        let close = if labels.is_empty() { "" } else { "}" };
        let _ = writeln!(self.0, "{close} {value}");
    }

    fn streams(&mut self, meters: &[StreamMeter]) {
        let all: Vec<_> = meters.iter().map(|meter| (meter, meter.counts())).collect();
        type Figure = fn(&crate::ring::Counts) -> u64;
        let figures: [(&str, &str, &str, Figure); 4] = [
            ("surfaced_samples_total", "counter", "Frames that came out of the ring.", |c| {
                c.received
            }),
            ("surfaced_lost_samples_total", "counter", "Frames that were lost.", |c| c.lost),
            ("surfaced_ring_fill", "gauge", "Frames in the ring now.", |c| c.fill),
            ("surfaced_ring_capacity", "gauge", "Frames that the ring can hold.", |c| c.capacity),
        ];
        for (name, kind, help, figure) in figures {
            self.head(name, kind, help);
            for (meter, counts) in &all {
                let labels = [("source", meter.id.as_str()), ("device", meter.device.as_str())];
                self.line(name, &labels, figure(counts));
            }
        }
    }

    fn outputs(&mut self, outputs: &[OutputView]) {
        type Figure = fn(&OutputView) -> u64;
        let figures: [(&str, &str, &str, Figure); 3] = [
            (
                "surfaced_output_failures_total",
                "counter",
                "Attempts at an output that failed.",
                |output| output.failures,
            ),
            (
                "surfaced_output_dropped_total",
                "counter",
                "Answers that made room for newer ones.",
                |output| output.dropped,
            ),
            ("surfaced_output_waiting", "gauge", "Answers that wait for an output.", |output| {
                output.waiting
            }),
        ];
        for (name, kind, help, figure) in figures {
            self.head(name, kind, help);
            for output in outputs {
                self.line(name, &[("output", &output.output)], figure(output));
            }
        }
    }

    fn precision(&mut self, precision: &[Precision]) {
        let name = "surfaced_reviewed_scans";
        self.head(name, "gauge", "Scans of which somebody said what they were.");
        for Precision { surface, corrected, right, .. } in precision {
            let answer = surface.as_deref().unwrap_or("unknown");
            for (verdict, count) in [("true", *right), ("false", corrected - right)] {
                self.line(name, &[("answer", answer), ("right", verdict)], count);
            }
        }
    }

    fn devices(&mut self, state: &State) {
        self.head("surfaced_device_streaming", "gauge", "Whether a device's data arrive.");
        for device in &state.devices {
            let streaming = u8::from(device.state == DeviceState::Streaming);
            self.line("surfaced_device_streaming", &[("device", &device.device)], streaming);
        }
        self.head("surfaced_reconnects_total", "counter", "How often a device came back.");
        for device in &state.devices {
            let count = state.reconnects.get(&device.device).copied().unwrap_or(0);
            self.line("surfaced_reconnects_total", &[("device", &device.device)], count);
        }
    }

    fn histogram(&mut self, name: &str, help: &str, histogram: &Histogram) {
        self.head(name, "histogram", help);
        let mut below = 0;
        let bucket = format!("{name}_bucket");
        for (bound, count) in histogram.bounds.iter().zip(&histogram.counts) {
            below += count;
            self.line(&bucket, &[("le", &bound.to_string())], below);
        }
        let all: u64 = histogram.counts.iter().sum();
        self.line(&bucket, &[("le", "+Inf")], all);
        self.line(&format!("{name}_sum"), &[], histogram.sum);
        self.line(&format!("{name}_count"), &[], all);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::station::StationEvent;

    #[test]
    fn buckets_add_up_and_labels_are_escaped() {
        let mut state = State::new();
        state.take(&StationEvent::Device {
            device: "a \"b\"\\\n\u{202e}".into(),
            state: DeviceState::Streaming,
            detail: String::new(),
        });
        let mut metrics = Metrics::default();
        for latency_s in [0.0005, 0.001, 0.003, 99.0] {
            metrics.scan(1.0, latency_s);
        }
        let elsewhere = Elsewhere {
            state: &state,
            meters: &[],
            traffic: &Traffic::default(),
            subscribers: 3,
            dropped_events: 4,
            missed_notices: 5,
            precision: &[],
            outputs: &[OutputView {
                output: "http://example/".into(),
                waiting: 7,
                failures: 2,
                dropped: 1,
                problem: None,
            }],
        };
        let text = metrics.text(&elsewhere);
        for line in [
            "surfaced_device_streaming{device=\"a \\\"b\\\"\\\\\\n\\\\u{202e}\"} 1",
            "surfaced_answer_latency_seconds_bucket{le=\"0.001\"} 2",
            "surfaced_answer_latency_seconds_bucket{le=\"0.005\"} 3",
            "surfaced_answer_latency_seconds_bucket{le=\"+Inf\"} 4",
            "surfaced_answer_latency_seconds_count 4",
            "surfaced_scan_seconds_sum 4",
            "surfaced_readers 3",
            "surfaced_output_failures_total{output=\"http://example/\"} 2",
            "surfaced_output_dropped_total{output=\"http://example/\"} 1",
            "surfaced_output_waiting{output=\"http://example/\"} 7",
            "surfaced_scans_total{answer=\"named\"} 0",
        ] {
            assert!(text.lines().any(|l| l == line), "{line}\n{text}");
        }
    }
}
