//! Shows T* and scan durations as a table, and as one sentence for each source.

use std::fmt::Write;

use super::{
    ByRule, CORRELATION, DurationReport, Estimator, PooledRow, PooledSettings, SourceDuration,
};
use crate::independence::algorithm1::Algorithm1Settings;
use crate::printable::{some_of, table};
use crate::scene::SourceId;

/// Most surfaces that a sentence names.
const SHOWN: usize = 6;

impl DurationReport {
    pub fn table(&self) -> String {
        match &self.settings {
            Estimator::Pooled(_) => self.rows(&[T_STAR, UPPER, SAMPLES, SCAN, EFFECTIVE, LASTING]),
            Estimator::Algorithm1(settings) => {
                self.rows(&[T_STAR, SAMPLES, SCAN]) + &self.longest(settings)
            }
        }
    }

    fn rows(&self, columns: &[Column]) -> String {
        let mut head = vec!["surface", "source", ">Q"];
        head.extend(columns.iter().map(|(head, _)| *head));
        head.push("");
        let row = |d: &SourceDuration| {
            let mut row = vec![d.surface.clone(), d.source.to_string(), d.trials.to_string()];
            row.extend(columns.iter().map(|(_, cell)| cell(d).unwrap_or_else(|| "–".into())));
            row.push(d.reason.clone().unwrap_or_default());
            row
        };
        table(&head, &self.durations.iter().map(row).collect::<Vec<_>>())
    }

    /// The result of `pooled` in words, one line for each source: the distance of nearly independent
    /// samples, how sure means over a scan of `scan_s` seconds and a trial are, and where there is no T*. Empty for Algorithm 1.
    pub fn in_words(&self, scan_s: Option<f64>) -> String {
        let mut out = String::new();
        if matches!(self.settings, Estimator::Pooled(_)) {
            for scene in &self.scene {
                // Writing to a String cannot fail.
                let _ = writeln!(out, "{}", self.source_in_words(&scene.source, scan_s));
            }
        }
        out
    }

    fn source_in_words(&self, source: &SourceId, scan_s: Option<f64>) -> String {
        let rows = || {
            let of_source = self.durations.iter().filter(|d| d.source == *source);
            of_source.filter_map(|d| Some((d, pooled(d)?)))
        };
        let mut spacings: Vec<f64> = rows().filter_map(|(d, _)| d.spacing_s()).collect();
        spacings.sort_unstable_by(f64::total_cmp);
        let dependence = match self.settings {
            Estimator::Pooled(PooledSettings { dependence }) => dependence,
            Estimator::Algorithm1(_) => CORRELATION,
        };
        let so_far =
            format!("apart depend on each other by less than a correlation of {dependence}");
        let mut text = match spacings[..] {
            [] => format!("{source}: no surface has a T*"),
            [first, .., last] if ms(first) != ms(last) => format!(
                "{source}: samples {} ms ({}) to {} ms ({}) {so_far}",
                ms(first),
                named(rows(), first),
                ms(last),
                named(rows(), last)
            ),
            [first, ..] => format!("{source}: samples {} ms {so_far}", ms(first)),
        };
        let fewest = rows()
            .filter_map(|(d, row)| Some((row.effective_samples?, &d.surface, row)))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        // The effective number says how sure a mean is; it is no count of samples T* apart.
        if let Some((effective, surface, row)) = fewest {
            let trial_s = row.trial_s.unwrap_or_default();
            let n = self.samples;
            let _ = match scan_s.filter(|s| *s < trial_s - 0.05) {
                Some(s) => write!(
                    text,
                    "; a mean over a scan of {s:.1} s is as sure as one of {:.0} independent samples \
                     or more ({surface}), over a whole trial of {trial_s:.1} s as one of {effective:.0}",
                    effective * s / trial_s
                ),
                None => write!(
                    text,
                    "; a mean over a whole trial of {trial_s:.1} s is as sure as one of {effective:.0} \
                     independent samples or more ({surface})"
                ),
            };
            if let Some(worth) = row.effective_of_n.filter(|worth| *worth < 0.9 * n as f64) {
                let _ = write!(text, ", and one of {n} samples of it as one of {worth:.0}");
            }
        }
        let more = rows().filter_map(|(_, row)| row.more_trials).max();
        let without = rows().filter(|(d, _)| d.t_star_s.is_none());
        let without: Vec<&str> = without.map(|(d, _)| d.surface.as_str()).collect();
        if !without.is_empty() && !spacings.is_empty() {
            let _ = write!(text, "; no T* on {}", some_of(&without, SHOWN, ", "));
        }
        if let Some(more) = more {
            let _ = write!(text, " (about {more} more trials would show it)");
        }
        text
    }

    fn longest(&self, settings: &Algorithm1Settings) -> String {
        let mut out = String::new();
        let n = self.samples;
        for s in &self.scene {
            let _ = match (&s.surface, s.scan_s) {
                (Some(surface), Some(scan)) => writeln!(
                    out,
                    "\n{}: a scan of {scan:.2} s gives {n} samples T* apart on every surface that \
                     has a T*; {surface} needs the most",
                    s.source
                ),
                _ => writeln!(out, "\n{}: no surface has a T* within the range", s.source),
            };
            if !s.without.is_empty() {
                let _ = writeln!(out, "  without a T*: {}", s.without.join(", "));
            }
        }
        let q = self.durations.iter().map(|d| d.trials).min().unwrap_or(0);
        let _ = writeln!(
            out,
            "\nrule {}, R = {}, α = {}. From Q = {q} trials: no dependence was seen at T*, which is \
             not a proof of independence.",
            settings.rule, settings.draws, settings.alpha
        );
        out
    }
}

/// The head of a column, as [`table`] expects it, and a function that gives its cells.
type Column = (&'static str, fn(&SourceDuration) -> Option<String>);

const T_STAR: Column = (">T* [ms]", |d| d.t_star_s.map(|t| format!("{:.2}", t * 1e3)));
const SAMPLES: Column = (">samples", |d| d.t_star_samples.map(|t| t.to_string()));
const SCAN: Column = (">scan [s]", |d| d.scan_s.map(|t| format!("{t:.2}")));
const UPPER: Column =
    (">surely by", |d| pooled(d)?.t_star_upper_s.map(|t| format!("{:.2}", t * 1e3)));
const EFFECTIVE: Column =
    (">independent", |d| pooled(d)?.effective_samples.map(|n| format!("{n:.0}")));
const LASTING: Column =
    (">lasting", |d| pooled(d)?.lasting_share.map(|share| format!("{:.0} %", 100.0 * share)));

fn pooled(d: &SourceDuration) -> Option<&PooledRow> {
    let ByRule::Pooled(row) = &d.by_rule else { return None };
    Some(row)
}

/// Formats seconds as milliseconds, rounded for reading.
fn ms(seconds: f64) -> String {
    let ms = 1e3 * seconds;
    match ms {
        ..1.0 => format!("{ms:.2}"),
        ..10.0 => format!("{ms:.1}"),
        _ => format!("{ms:.0}"),
    }
}

fn named<'a>(
    mut rows: impl Iterator<Item = (&'a SourceDuration, &'a PooledRow)>,
    spacing_s: f64,
) -> &'a str {
    rows.find(|(d, _)| d.spacing_s() == Some(spacing_s)).map_or("", |(d, _)| &d.surface)
}
