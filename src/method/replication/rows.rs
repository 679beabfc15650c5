//! The numbers in the paper's tables and text, and the settings in which they were measured.

use crate::evaluate::Protocol;
use crate::library::Entry;
use crate::scene::{Colour, Domain, Scene};
use crate::trial::Signal;

/// A result that the paper prints, in percent.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Published {
    pub accuracy: f64,
    /// Standard deviation of the accuracy over folds, if it is printed.
    pub std: Option<f64>,
    pub precision: Option<f64>,
}

/// One setting of the paper's evaluation, which is a row of the report.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Row {
    /// The place in the paper: a table, `text` or the figure of `pairs`; `beside` if it has none.
    pub place: &'static str,
    /// The name; no other row has the same name, protocol and place.
    pub name: String,
    pub protocol: Protocol,
    #[serde(skip)]
    pub terms: Vec<(f64, SampledSource)>,
    pub published: Option<Published>,
}

pub(super) const TABLE_1: &str = "Table I";
pub(super) const TABLE_2: &str = "Table II";
const TEXT: &str = "text";
const FIGURE: &str = "pairs";
const OURS: &str = "beside";

fn used(sources: &[&str]) -> Vec<SampledSource> {
    sources.iter().map(|source| SampledSource::as_used(source)).collect()
}

fn changed(change: impl Fn(SampledSource) -> SampledSource) -> Vec<SampledSource> {
    AS_USED.iter().map(|&stream| change(stream)).collect()
}

fn is_image(stream: SampledSource) -> bool {
    matches!(stream.view, SampleView::Pixels(_))
}

fn mean(accuracy: f64, std: f64) -> Option<Published> {
    Some(Published { accuracy, std: (std > 0.0).then_some(std), precision: None })
}

/// A row in which all streams have the same weight.
fn row(
    place: &'static str,
    protocol: Protocol,
    name: impl Into<String>,
    streams: Vec<SampledSource>,
    published: Option<Published>,
) -> Row {
    let terms = streams.into_iter().map(|stream| (1.0, stream)).collect();
    Row { place, name: name.into(), protocol, terms, published }
}

/// All settings, in the order shown. The `Table I` row named [`ALL`] is the paper's main result.
pub fn rows() -> Vec<Row> {
    let mut rows = Vec::new();
    table_1(&mut rows);
    text(&mut rows);
    table_2(&mut rows);
    pairs(&mut rows);
    rows
}

pub const ALL: &str = "all eight";

fn table_1(rows: &mut Vec<Row>) {
    let protocol = Protocol::ExpertVsUsers;
    let mut add = |name: &str, streams, accuracy, std| {
        rows.push(row(TABLE_1, protocol, name, streams, mean(accuracy, std)));
    };
    add("visual", used(&["ca1", "ca2"]), 74.8, 2.5);
    add("auditory", used(&["mi1", "mi2"]), 54.8, 16.3);
    add("haptic", used(&["ac", "fr"]), 61.6, 6.0);
    add("visual + auditory", used(&["ca1", "ca2", "mi1", "mi2"]), 84.1, 7.3);
    add("visual + haptic", used(&["ca1", "ca2", "ac", "fr"]), 92.7, 2.2);
    add("auditory + haptic", used(&["mi1", "mi2", "ac", "fr"]), 74.2, 10.9);
    let rgb = changed(|s| {
        if is_image(s) { SampledSource { view: SampleView::Pixels(Colour::Rgb), ..s } } else { s }
    });
    add("all, RGB instead of HSV", rgb, 95.8, 2.7);
    let in_time = |sound: SampleView| {
        changed(move |s| match (s.source, s.view) {
            ("mi2", _) => SampledSource { view: sound, ..s },
            (_, SampleView::Spectrum) => SampledSource { view: SampleView::Time, ..s },
            _ => s,
        })
    };
    let beginning = in_time(SampleView::TimeOfSerial);
    add("all, without DFT (drag sound: its first 1.1 s)", beginning, 95.1, 3.3);
    add("all, without the shift", changed(|s| SampledSource { align: false, ..s }), 88.7, 6.7);
    let main = Published { accuracy: 97.2, std: Some(2.1), precision: Some(98.0) };
    rows.push(row(TABLE_1, protocol, ALL, AS_USED.to_vec(), Some(main)));
    let whole = in_time(SampleView::Time);
    rows.push(row(OURS, protocol, "all, without DFT (whole drag sound)", whole, None));
}

fn text(rows: &mut Vec<Row>) {
    let (users, trials, others) =
        (Protocol::ExpertVsUsers, Protocol::LeaveOneTrialOut, Protocol::AllVsOneUser);
    let mut both = Vec::new();
    for stream in AS_USED {
        let views = match stream.view {
            view @ SampleView::Pixels(_) => vec![view],
            _ => vec![SampleView::Time, SampleView::Spectrum],
        };
        both.extend(views.into_iter().map(|view| SampledSource { view, ..stream }));
    }
    let shifted = changed(|s| SampledSource { align: s.align || is_image(s), ..s });
    let unshifted = changed(|s| SampledSource { align: false, ..s });
    let ac = SampledSource { align: false, ..SampledSource::as_used("ac") };
    let camera_and_ac = vec![SampledSource::as_used("ca1"), ac];
    let all = AS_USED.to_vec();
    let mut weighted = row(TEXT, users, "all, ca1 and ac weigh 3", all.clone(), mean(98.5, 1.2));
    for (weight, stream) in &mut weighted.terms {
        if matches!(stream.source, "ca1" | "ac") {
            *weight = 3.0;
        }
    }
    rows.push(row(TEXT, users, "all, both domains", both, mean(98.2, 1.7)));
    rows.push(weighted);
    let mut add = |place, protocol, name: &str, streams, published| {
        rows.push(row(place, protocol, name, streams, published));
    };
    add(TEXT, users, "all, images shifted, too", shifted, mean(97.1, 2.2));
    for (source, figures) in [("ca1", [42.0, 34.0, 27.0]), ("ca2", [19.0, 18.0, 17.0])] {
        let channels =
            [("hue", Colour::Hue), ("saturation", Colour::Saturation), ("value", Colour::Value)];
        for ((name, colour), figure) in channels.into_iter().zip(figures) {
            let stream = SampledSource::new(source, SampleView::Pixels(colour), false);
            add(TEXT, users, &format!("{source}, {name}"), vec![stream], mean(figure, 0.0));
        }
    }
    add(TEXT, others, ALL, all.clone(), mean(99.4, 0.8));
    add(TEXT, others, "all, without the shift", unshifted.clone(), mean(99.1, 0.9));
    add(TEXT, others, "ca1", used(&["ca1"]), mean(88.9, 3.7));
    add(TEXT, others, "ca1 + ac", used(&["ca1", "ac"]), mean(96.9, 1.4));
    add(OURS, others, "ca1 + ac, without the shift", camera_and_ac.clone(), None);
    add(TEXT, trials, "ca1 + ac, without the shift", camera_and_ac, mean(97.1, 1.2));
    add(OURS, trials, ALL, all, None);
    add(OURS, trials, "all, without the shift", unshifted, None);
}

/// Cells of Table II for one source and protocol, each a mean and a standard deviation. The first index
/// is 0 without the shift and 1 with it; the second is 0 for time or RGB and 1 for spectrum or HSV.
type Cells = [[(f64, f64); 2]; 2];

#[rustfmt::skip]
const SINGLES: [(&str, Cells, Cells); 8] = [
    ("mi1", [[(50.9, 16.4), (48.4, 18.3)], [(47.6, 18.0), (55.9, 15.4)]],
            [[(22.4, 5.0), (19.0, 3.1)], [(21.1, 3.5), (27.1, 3.7)]]),
    ("mi2", [[(4.2, 1.2), (6.6, 1.3)], [(4.3, 1.5), (15.3, 3.3)]],
            [[(12.6, 2.9), (39.9, 4.3)], [(13.0, 2.6), (41.0, 2.7)]]),
    ("ac",  [[(48.3, 5.6), (26.4, 1.8)], [(45.8, 4.5), (43.8, 2.3)]],
            [[(46.9, 9.8), (72.8, 6.9)], [(52.6, 7.5), (56.6, 7.5)]]),
    ("fr",  [[(14.2, 3.9), (5.6, 1.7)], [(20.2, 7.5), (7.1, 2.2)]],
            [[(33.5, 12.2), (22.0, 6.3)], [(12.4, 4.8), (10.6, 4.1)]]),
    ("ir",  [[(23.7, 4.6), (8.0, 2.1)], [(23.5, 3.7), (12.3, 2.8)]],
            [[(55.5, 5.1), (28.0, 4.3)], [(23.8, 4.5), (24.9, 2.7)]]),
    ("me",  [[(8.5, 1.3), (8.1, 1.2)], [(7.6, 1.3), (4.4, 1.5)]],
            [[(8.8, 0.8), (9.4, 0.9)], [(7.9, 0.8), (5.4, 1.2)]]),
    ("ca1", [[(53.3, 2.6), (65.1, 2.9)], [(49.0, 2.6), (64.1, 3.6)]],
            [[(76.7, 4.8), (84.6, 4.9)], [(68.3, 3.9), (82.3, 4.1)]]),
    ("ca2", [[(39.1, 2.0), (42.6, 1.7)], [(35.4, 3.6), (43.5, 3.6)]],
            [[(65.5, 5.8), (74.2, 5.7)], [(61.4, 4.9), (70.4, 5.3)]]),
];

fn table_2(rows: &mut Vec<Row>) {
    for (source, users, trials) in SINGLES {
        let views = if source.starts_with("ca") {
            [("RGB", SampleView::Pixels(Colour::Rgb)), ("HSV", SampleView::Pixels(Colour::Hsv))]
        } else {
            [("time", SampleView::Time), ("spectrum", SampleView::Spectrum)]
        };
        for (protocol, cells) in
            [(Protocol::ExpertVsUsers, users), (Protocol::LeaveOneTrialOut, trials)]
        {
            for ((shift, align), of_shift) in
                [("no shift", false), ("shift", true)].into_iter().zip(cells)
            {
                for ((how, view), (accuracy, std)) in views.into_iter().zip(of_shift) {
                    let stream = SampledSource::new(source, view, align);
                    let name = format!("{source}, {how}, {shift}");
                    rows.push(row(TABLE_2, protocol, name, vec![stream], mean(accuracy, std)));
                }
            }
        }
    }
}

/// Adds a row for each pair of sources. The paper prints one pair's accuracy and draws the rest.
fn pairs(rows: &mut Vec<Row>) {
    for (at, a) in AS_USED.iter().enumerate() {
        for b in &AS_USED[at + 1..] {
            let printed = (a.source, b.source) == ("ca1", "ac");
            let name = format!("{} + {}", a.source, b.source);
            let published = if printed { mean(87.9, 0.0) } else { None };
            rows.push(row(FIGURE, Protocol::ExpertVsUsers, name, vec![*a, *b], published));
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum SampleView {
    /// Equidistant in time.
    Time,
    /// Equidistant in time in the first 48,000 frames: whole 10 kHz series, but 1.1 s of a drag
    /// sound (a quirk of the paper's test without DFT, `src/method/README.md` §2).
    TimeOfSerial,
    /// Bins of the amplitude spectrum: in the source's band or, if it has none, from 0 to 1000 Hz.
    Spectrum,
    Pixels(Colour),
}

/// Number of frames in each 10 kHz series of LMT108.
const SERIAL_FRAMES: usize = 48_000;
/// The band, in Hz, for spectra of sources that are normally sampled in time: that of acceleration.
const BAND_HZ: (f64, f64) = (0.0, 1000.0);

/// A stream: a source, how it is sampled, and whether the query is shifted to equal means (Eq. 8).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SampledSource {
    pub source: &'static str,
    pub view: SampleView,
    pub align: bool,
}

/// The eight sources as the paper uses them.
pub(super) const AS_USED: [SampledSource; 8] = [
    SampledSource::new("ca1", SampleView::Pixels(Colour::Hsv), false),
    SampledSource::new("ca2", SampleView::Pixels(Colour::Hsv), false),
    SampledSource::new("mi1", SampleView::Spectrum, true),
    SampledSource::new("mi2", SampleView::Spectrum, true),
    SampledSource::new("ac", SampleView::Spectrum, true),
    SampledSource::new("fr", SampleView::Time, true),
    SampledSource::new("ir", SampleView::Time, true),
    SampledSource::new("me", SampleView::Time, false),
];

impl SampledSource {
    pub const fn new(source: &'static str, view: SampleView, align: bool) -> Self {
        Self { source, view, align }
    }

    /// The stream in which the paper's main result uses a source.
    ///
    /// # Panics
    /// If the paper has no such source.
    pub fn as_used(source: &str) -> Self {
        let found = AS_USED.iter().find(|stream| stream.source == source);
        *found.expect("one of the paper's eight sources")
    }

    /// The scene with this stream alone; `None` if the scene does not have the source.
    pub fn scene(&self, base: &Scene) -> Option<Scene> {
        let id = base.get(self.source)?.id.clone();
        let scene = base.clone().only(&[id]).ok()?;
        Some(scene.changed(|spec| {
            spec.align_mean = self.align;
            spec.weight = 1.0;
            match self.view {
                SampleView::Time | SampleView::TimeOfSerial => {
                    spec.domain = Domain::Time { band_hz: None }
                }
                SampleView::Spectrum if matches!(spec.domain, Domain::Spectrum { .. }) => {}
                SampleView::Spectrum => spec.domain = Domain::Spectrum { band_hz: BAND_HZ },
                SampleView::Pixels(colour) => spec.colour = colour,
            }
        }))
    }

    /// The entry with this stream's source alone, cut if the stream uses only its beginning.
    pub fn entry(&self, entry: &Entry, scene: &Scene) -> Entry {
        let entry = entry.clone().within(scene);
        if self.view != SampleView::TimeOfSerial {
            return entry;
        }
        entry.changed(|mut trial| {
            for signal in trial.signals.values_mut() {
                if let Signal::Series(series) = signal {
                    *series = series.crop(0, SERIAL_FRAMES);
                }
            }
            trial
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_setting_has_a_name_of_its_own_and_the_streams_are_few() {
        let rows = rows();
        let names: BTreeSet<_> =
            rows.iter().map(|r| (r.place, r.protocol.name(), r.name.clone())).collect();
        assert_eq!(names.len(), rows.len());
        assert_eq!(rows.iter().filter(|row| row.place == TABLE_2).count(), 64);
        let streams: BTreeSet<_> = rows.iter().flat_map(|r| &r.terms).map(|(_, s)| *s).collect();
        assert_eq!(streams.len(), 39, "each is compared once, whatever the number of rows");
    }
}
