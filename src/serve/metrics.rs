//! Metrics for Prometheus, in its text format 0.0.4.
//!
//! See <https://prometheus.io/docs/instrumenting/exposition_formats/>. A metric takes a few lines of
//! text. No registry is used, since the rings' meters hold the counts.

use std::fmt::{Display, Write};
use std::sync::atomic::{AtomicU64, Ordering};

use super::guard::Traffic;
use super::hub::{Histogram, HubState};
use crate::device::DeviceState;
use crate::history::{Drift, Precision, Quantity};
use crate::outputs::OutputView;
use crate::printable::Printable;
use crate::ring::Counts;

pub(super) const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

impl HubState {
    /// The metrics as text; `missed` counts the notices that the server missed.
    pub(super) fn metrics(
        &self,
        outputs: &[OutputView],
        (precision, drift): (&[Precision], &Drift),
        traffic: &Traffic,
        missed: u64,
    ) -> String {
        let mut page = MetricsPage::default();
        let (state, dropped) = (&self.state, self.subscribers.dropped);
        let info = ("surfaced_info", "gauge", "The version of the program.");
        page.family([info], [(vec![("version", state.version)], [1])]);
        let heads = [
            ("surfaced_healthy", "gauge", "Whether the station has not ended, as `/healthz` says."),
            ("surfaced_ready", "gauge", "Whether scans can be named now, as `/readyz` says."),
        ];
        let ready = state.lacking().is_empty();
        page.family(heads, [(vec![], [u64::from(!state.finished), u64::from(ready)])]);
        let heads = [
            ("surfaced_samples_total", "counter", "Frames that came out of the ring."),
            ("surfaced_lost_samples_total", "counter", "Frames that were lost."),
            ("surfaced_ring_fill", "gauge", "Frames in the ring now."),
            ("surfaced_ring_capacity", "gauge", "Frames that the ring can hold."),
        ];
        let streams = self.meters.iter().map(|meter| {
            let labels = vec![("source", meter.id.as_str()), ("device", meter.device.as_str())];
            let Counts { received, lost, fill, capacity, .. } = meter.counts();
            (labels, [received, lost, fill, capacity])
        });
        page.family(heads, streams);
        let heads = [
            ("surfaced_device_streaming", "gauge", "Whether a device's data arrive."),
            ("surfaced_reconnects_total", "counter", "How often a device came back."),
        ];
        let devices = state.devices.iter().map(|view| {
            let streams = u64::from(view.state == DeviceState::Streaming);
            (vec![("device", view.device.as_str())], [streams, view.reconnects])
        });
        page.family(heads, devices);
        let counts = state.counts;
        let others = counts.nearest + counts.unsure + counts.unknown;
        let answers = [
            ("named", counts.scans - others),
            ("nearest", counts.nearest),
            ("unsure", counts.unsure),
            ("unknown", counts.unknown),
            ("unnamed", counts.unnamed),
        ];
        let head = ("surfaced_scans_total", "counter", "Scans that were answered.");
        page.family([head], answers.map(|(of, count)| (vec![("answer", of)], [count])));
        let count = |of: &AtomicU64| of.load(Ordering::Relaxed);
        let (requests, refused) = (count(&traffic.requests), count(&traffic.refused));
        for (name, help, value) in [
            ("surfaced_scans_spoiled_total", "Scans that should not be trusted.", counts.spoiled),
            ("surfaced_scans_enrolled_total", "Scans kept for the library.", counts.enrolled),
            ("surfaced_warnings_total", "Warnings.", counts.warnings),
            ("surfaced_http_requests_total", "Requests that were read.", requests),
            ("surfaced_http_refused_total", "Requests and connections refused.", refused),
            ("surfaced_events_dropped_total", "Events that a slow subscriber missed.", dropped),
            ("surfaced_notices_missed_total", "Notices that the server missed.", missed),
        ] {
            page.family([(name, "counter", help)], [(vec![], [value])]);
        }
        let heads = [
            ("surfaced_output_failures_total", "counter", "Attempts at an output that failed."),
            ("surfaced_output_dropped_total", "counter", "Answers that made room for newer ones."),
            ("surfaced_output_waiting", "gauge", "Answers that wait for an output."),
        ];
        let outputs = outputs.iter().map(|output| {
            let OutputView { output, alert, waiting, failures, dropped, .. } = output;
            // Several alerts may share one address.
            let alert = alert.as_deref().map(|alert| ("alert", alert));
            let labels = [("output", output.as_str())].into_iter().chain(alert);
            (labels.collect(), [*failures, *dropped, *waiting])
        });
        page.family(heads, outputs);
        let help = "Scans of which somebody said what they were.";
        let reviewed = precision.iter().flat_map(|of| {
            let answer = of.surface.as_deref().unwrap_or("unknown");
            [("true", of.right), ("false", of.corrected - of.right)]
                .map(|(right, count)| (vec![("answer", answer), ("right", right)], [count as u64]))
        });
        page.family([("surfaced_reviewed_scans", "gauge", help)], reviewed);
        let scans = drift.references.iter();
        let scans = scans.map(|of| (vec![("surface", of.surface.as_str())], [of.scans as u64]));
        let help = "Scans of a reference surface since it was made one.";
        page.family([("surfaced_reference_scans", "gauge", help)], scans);
        let help = "Things that have drifted, by scans of the reference surfaces.";
        let kinds = [
            ("fit", Quantity::Fit),
            ("distance", Quantity::Distance),
            ("level", Quantity::Level),
            ("noise", Quantity::Noise),
        ];
        let drifted = kinds.map(|(name, kind)| {
            let charts = drift.references.iter().flat_map(|of| &of.series);
            let count = charts.filter(|chart| chart.quantity == kind && chart.drifted).count();
            (vec![("quantity", name)], [count as u64])
        });
        page.family([("surfaced_drifted", "gauge", help)], drifted);
        let head = ("surfaced_readers", "gauge", "Subscribers to the stream of events.");
        page.family([head], [(vec![], [self.subscribers.count() as u64])]);
        page.histogram("surfaced_scan_seconds", "Duration of a scan.", &self.scan_s);
        let help = "From the end of a scan to its name.";
        page.histogram("surfaced_answer_latency_seconds", help, &self.latency_s);
        page.0
    }
}

type Labels<'a> = Vec<(&'a str, &'a str)>;

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

    /// Writes several metrics about the same things. `heads` has name, kind and help of each
    /// metric, and each thing has its labels and one value for each metric.
    fn family<'a, const N: usize>(
        &mut self,
        heads: [(&str, &str, &str); N],
        things: impl IntoIterator<Item = (Labels<'a>, [u64; N])>,
    ) {
        let things: Vec<_> = things.into_iter().collect();
        for (at, (name, kind, help)) in heads.into_iter().enumerate() {
            self.head(name, kind, help);
            things.iter().for_each(|(labels, values)| self.line(name, labels, values[at]));
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
    use std::sync::Arc;

    use axum::body::Bytes;

    use super::*;
    use crate::serve::subscribers::EventFilter;
    use crate::station::StationEvent;

    #[test]
    fn buckets_add_up_labels_are_escaped_and_the_dashboard_shows_what_is_there() {
        let mut hub = HubState::new(Arc::default());
        hub.state.take(&StationEvent::Device {
            device: "a \"b\"\\\n\u{202e}".into(),
            state: DeviceState::Streaming,
            detail: String::new(),
        });
        for latency in [0.0005, 0.001, 0.003, 99.0] {
            hub.scan_s.observe(1.0);
            hub.latency_s.observe(latency);
        }
        let _readers = [(); 3].map(|()| hub.subscribers.subscribe(EventFilter::ALL, Bytes::new()));
        let of = |alert: Option<&str>, waiting| {
            let (output, alert, problem) = ("http://example/".into(), alert.map(Into::into), None);
            OutputView { output, alert, waiting, failures: 2, dropped: 1, problem }
        };
        let outputs = [of(None, 7), of(Some("wrong"), 8), of(Some("worn"), 9)];
        let text = hub.metrics(&outputs, (&[], &Drift::default()), &Traffic::default(), 5);
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
            "surfaced_output_waiting{output=\"http://example/\",alert=\"wrong\"} 8",
            "surfaced_output_waiting{output=\"http://example/\",alert=\"worn\"} 9",
            "surfaced_scans_total{answer=\"named\"} 0",
        ] {
            assert!(text.lines().any(|l| l == line), "{line}\n{text}");
        }
        let dashboard = include_str!("../../configs/grafana.json");
        for part in dashboard.split("surfaced_").skip(1) {
            let name = part.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap();
            assert!(text.contains(&format!("surfaced_{name}")), "the dashboard shows {name}");
        }
    }
}
