//! Options for early answers and for unknown surfaces.

use super::common::share;
use super::show;
use crate::recognise::{Rejection, RejectionError, ScanTime, Settling};
use crate::station::Recogniser;

/// Options for early answers and for unknown surfaces.
#[derive(Clone, Debug, clap::Args)]
pub struct AnswerArgs {
    /// Accuracy that answers may lose by settling before their scans end
    #[arg(long, default_value_t = 0.01, value_name = "SHARE", value_parser = share)]
    pub settle_loss: f64,
    /// Share of scans of known surfaces that may be called unknown; 0 calls none so (default: 0.01,
    /// or as low as the library's trials can show)
    #[arg(long, value_name = "SHARE", value_parser = share_or_none)]
    false_rejections: Option<f64>,
}

fn share_or_none(text: &str) -> Result<f64, String> {
    if text.parse() == Ok(0.0) { Ok(0.0) } else { share(text) }
}

impl AnswerArgs {
    /// The share of false rejections that was given; 0 for none.
    pub fn false_rejections(&self) -> Option<f64> {
        self.false_rejections
    }

    /// Sets a recogniser up, and says what its answers rest on.
    ///
    /// # Errors
    /// If a share of false rejections was given and unknown surfaces cannot be recognised.
    pub fn apply(&self, by: &mut Recogniser) -> Result<Applied, RejectionError> {
        let mut remarks = Vec::new();
        if self.false_rejections != Some(0.0) {
            match by.reject_unknown(self.false_rejections) {
                Ok(rejections) => remarks.extend(on_unknown(&rejections)),
                Err(error) if self.false_rejections.is_some() => return Err(error),
                Err(error) => remarks.push(format!("unknown surfaces are not detected: {error}")),
            }
        }
        let found = by.calibrate(self.settle_loss);
        let (settling, scan_times): (Vec<Settling>, Vec<ScanTime>) = found.into_iter().unzip();
        remarks.extend(on_settling(&settling));
        remarks.extend(on_scan_time(scan_times.iter()));
        by.add_remarks(&remarks);
        Ok(Applied { follows: !settling.is_empty(), remarks })
    }
}

/// The abilities of a recogniser that was set up.
pub struct Applied {
    /// Whether it follows scans in progress.
    pub follows: bool,
    /// The basis of its answers, a line each.
    pub remarks: Vec<String>,
}

fn on_unknown(rejections: &[Rejection]) -> Option<String> {
    let least = rejections.iter().min_by_key(|rejection| rejection.trials)?;
    Some(format!(
        "unknown surfaces are detected; at most {} of scans of known surfaces are called unknown by \
         mistake (95 % interval {} to {}, from {} left-out trials{})",
        show::percent(least.rate),
        show::percent(least.rate_low),
        show::percent(least.rate_high),
        least.trials,
        if least.across_people { "" } else { "; for this person" },
    ))
}

fn on_settling(found: &[Settling]) -> Option<String> {
    let first = found.first()?;
    let ruled: Vec<&Settling> = found.iter().filter(|settling| settling.rule.is_some()).collect();
    if ruled.is_empty() {
        return Some(
            "answers come when scans end; this library has too few trials to answer earlier".into(),
        );
    }
    let mean_s = ruled.iter().map(|settling| settling.scan_s).sum::<f64>() / ruled.len() as f64;
    let unproven = if found.iter().all(|settling| settling.shown) {
        String::new()
    } else {
        format!("; with {} left-out trials, this limit is not proven", first.trials)
    };
    Some(format!(
        "answers settle after {mean_s:.2} s of scan on average, at a cost in accuracy of at most \
         {}{unproven}",
        show::percent(first.stated_loss)
    ))
}

/// The scan time; of several libraries, the longest one.
fn on_scan_time<'a>(found: impl Iterator<Item = &'a ScanTime>) -> Option<String> {
    let longest = |answer: &&ScanTime| answer.scan_s().unwrap_or(f64::INFINITY);
    let answer = found.max_by(|a, b| longest(a).total_cmp(&longest(b)))?;
    Some(answer.line())
}
