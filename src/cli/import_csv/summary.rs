//! The result of an import, in words.

use std::collections::{BTreeMap, BTreeSet};

use crate::cli::show::{self, counted};
use crate::dataset::tables::{Clock, Form, MOST_TURNED, Said};
use crate::scene::SourceId;
use crate::trial::{Series, Signal, Trial};

/// The result for people.
#[derive(Default)]
pub(super) struct Summary {
    /// The lowest and the highest rate of each source.
    rates: BTreeMap<SourceId, (f64, f64)>,
    /// For each surface: trials, users, seconds.
    surfaces: BTreeMap<String, (usize, BTreeSet<String>, f64)>,
    /// For each source and channel: its value if it never changes within a trial, by trial.
    constant: BTreeMap<(SourceId, usize), Option<BTreeSet<u32>>>,
    said: Said,
    /// Tables that were cut into several trials.
    pub(super) of_several: usize,
}

impl Summary {
    pub(super) fn add(&mut self, trial: &Trial) {
        for (id, signal) in &trial.signals {
            if let Signal::Series(series) = signal {
                let hz = series.rate_hz();
                let (low, high) = self.rates.entry(id.clone()).or_insert((hz, hz));
                (*low, *high) = (low.min(hz), high.max(hz));
                self.constants(id, series);
            }
        }
        let of = self.surfaces.entry(trial.key.surface.clone()).or_default();
        of.0 += 1;
        of.1.insert(trial.key.user.clone());
        of.2 += trial.longest_s(|_| true).unwrap_or(0.0);
    }

    fn constants(&mut self, id: &SourceId, series: &Series) {
        for channel in 0..series.channels() {
            let first = series.samples()[channel];
            let mut samples = series.samples().iter().skip(channel).step_by(series.channels());
            let known = self.constant.entry((id.clone(), channel));
            let known = known.or_insert_with(|| Some(BTreeSet::new()));
            if let Some(values) = known {
                match samples.all(|x| *x == first) {
                    true => drop(values.insert(first.to_bits())),
                    false => *known = None,
                }
            }
        }
    }

    pub(super) fn said(&mut self, said: Said) {
        self.said.times = self.said.times.take().or(said.times);
        self.said.resampled_hz = self.said.resampled_hz.or(said.resampled_hz);
        self.said.own_rates |= said.own_rates;
        self.said.overtaken += said.overtaken;
        self.said.repeated += said.repeated;
        self.said.filled += said.filled;
        self.said.cut += said.cut;
        self.said.too_short += said.too_short;
        self.said.no_rows += said.no_rows;
        self.said.unlabelled += said.unlabelled;
        self.said.coarse.extend(said.coarse);
        self.said.running.extend(said.running);
        self.said.further.extend(said.further);
        self.said.parted_by = self.said.parted_by.take().or(said.parted_by);
    }

    pub(super) fn print(&self, form: &Form) {
        let rows = form.sources.iter().map(|(id, columns)| {
            let rate = match self.rates.get(id) {
                None => String::new(),
                Some((low, high)) if low == high => format!("{low} Hz"),
                Some((low, high)) => format!("{low} to {high} Hz"),
            };
            vec![id.to_string(), columns.join(", "), rate]
        });
        show::table(&["source", "columns", ">rate"], rows);
        result!();
        let rows = self.surfaces.iter().map(|(surface, (count, users, seconds))| {
            let mean = format!("{:.1} s", seconds / *count as f64);
            vec![surface.clone(), count.to_string(), mean, show::listed(users)]
        });
        show::table(&["surface", ">trials", ">mean length", "by"], rows);
        let said = &self.said;
        if matches!(form.clock, Clock::Rate(_)) && form.widest() > MOST_TURNED {
            say!(
                "each row is read as one sample of {} channels; if it is a whole trial, turn the table, or save it as \
                 .npy",
                form.widest()
            );
        }
        said.times.iter().for_each(|times| say!("{times}"));
        if said.own_rates {
            say!(
                "sources have rows of their own, and so their own rates; uneven rows are resampled by straight \
                 lines"
            );
        } else if let (Clock::Times { column, .. }, Some(hz)) = (&form.clock, said.resampled_hz) {
            say!(
                "rows come {hz:.1} times a second by `{column}`; they are resampled by straight lines"
            );
        }
        for (what, count, thing, then) in [
            ("after rows of later times", said.overtaken, "row", "; sorted by their times"),
            ("repeated times", said.repeated, "row", "; of each time, the last row is used"),
            ("filled in by straight lines", said.filled, "value", "; trial.toml says which"),
            (
                "cut at gaps, or where another trial may begin",
                said.cut,
                "trial",
                "; each part is one",
            ),
            ("too short between gaps", said.too_short, "part", "; left out"),
            ("text, or cut off", said.no_rows, "line", "; left out"),
            ("without a label", said.unlabelled, "row", "; left out"),
        ] {
            if count > 0 {
                say!("{what}: {}{then}", counted(count, thing));
            }
        }
        if let Some(name) = &said.parted_by {
            say!(
                "trials are parted where column `{name}` begins anew; number them by --trial if that is wrong"
            );
        }
        if !said.further.is_empty() {
            let names = show::listed(&said.further);
            say!("columns that the first table does not have are not used: {names}");
        }
        for name in &said.coarse {
            say!(
                "warning: column `{name}` has more digits than a sample holds (24 bits), so that most of its \
                 steps are lost; subtract a constant from it first"
            );
        }
        for name in &said.running {
            say!(
                "warning: channel {name} rises like a clock or a counter; leave it out by naming the others by \
                 --source"
            );
        }
        for ((id, channel), values) in &self.constant {
            let column = form.sources.iter().find(|(source, _)| source == id);
            let Some(name) = column.and_then(|(_, columns)| columns.get(*channel)) else {
                continue;
            };
            match values.as_ref().map(BTreeSet::len) {
                Some(1) => {
                    say!("column `{name}` never changes; leave it out by naming others by --source")
                }
                Some(_) => say!(
                    "warning: column `{name}` never changes within a trial, like a label, which would give \
                     the answer away; leave it out by naming others by --source"
                ),
                None => {}
            }
        }
    }
}
