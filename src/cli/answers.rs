//! Options for early answers and for unknown surfaces.

use std::sync::Arc;

use super::{Done, Failure, share, show};
use crate::recognise::{Model, Rejection, RejectionError, ScanTime, Settling};
use crate::station::Recogniser;

/// Options for early answers and for unknown surfaces.
#[derive(Clone, Debug, clap::Args)]
pub struct AnswerArgs {
    /// Accuracy that may be lost by giving answers before their scans end
    #[arg(long, default_value_t = 0.01, value_name = "SHARE", value_parser = share)]
    pub settle_loss: f64,
    /// Share of scans of known surfaces that may be called unknown; 0 calls none unknown (default:
    /// 0.01, or the lowest share that the library's trials support)
    #[arg(long, value_name = "SHARE", value_parser = share_or_none)]
    pub false_rejections: Option<f64>,
}

/// The accuracy that a scan should reach; the scan time follows from it.
#[derive(Clone, Debug, clap::Args)]
pub struct AccuracyArgs {
    /// Share of scans that must be named right by the scan time (default: the share for whole
    /// scans, minus 0.01)
    #[arg(long, value_name = "SHARE", value_parser = share, conflicts_with = "plan")]
    accuracy: Option<f64>,
}

impl AccuracyArgs {
    /// How long scans must last with the model of a library; `None` if the method cannot tell.
    pub fn scan_time(&self, model: &Arc<dyn Model>) -> Result<Option<ScanTime>, Failure> {
        let found = model.clone().scan_time(self.accuracy);
        match &found {
            Some(answer) if self.accuracy.is_some() => honoured(answer)?,
            None if self.accuracy.is_some() => {
                return Err(Failure::usage(
                    "--accuracy goes with --method embedding, which follows scans",
                ));
            }
            _ => {}
        }
        Ok(found)
    }
}

/// Fails if no scan time reaches the accuracy that was asked for.
pub fn honoured(answer: &ScanTime) -> Done {
    match answer.scan_s() {
        Some(_) => Ok(()),
        None => Err(Failure::Failed(answer.reason().unwrap_or_default())),
    }
}

fn share_or_none(text: &str) -> Result<f64, String> {
    if text.parse() == Ok(0.0) { Ok(0.0) } else { share(text) }
}

impl AnswerArgs {
    /// Applies these options to a recogniser. Returns whether it also guesses while a scan is in
    /// progress, and lines of text that say what its answers are based on.
    pub fn apply(&self, by: &mut Recogniser) -> Result<(bool, Vec<String>), RejectionError> {
        let mut remarks = Vec::new();
        if self.false_rejections != Some(0.0) {
            match by.reject_unknown(self.false_rejections) {
                Ok(rejections) => remarks.extend(on_unknown(&rejections)),
                Err(error) if self.false_rejections.is_some() => return Err(error),
                Err(error) => remarks.push(format!("unknown surfaces are not detected: {error}")),
            }
        }
        let settling = by.calibrate(self.settle_loss);
        remarks.extend(on_settling(&settling));
        by.library.remarks.extend_from_slice(&remarks);
        Ok((!settling.is_empty(), remarks))
    }
}

fn on_unknown(rejections: &[Rejection]) -> Option<String> {
    let least = rejections.iter().min_by_key(|rejection| rejection.trials)?;
    let [rate, low, high] = [least.rate, least.rate_low, least.rate_high].map(show::percent);
    let of_whom = if least.across_people { "" } else { "; for this person" };
    Some(format!(
        "unknown surfaces are detected; at most {rate} of scans of known surfaces are called unknown \
         by mistake (95 % interval {low} to {high}, from {} left-out trials{of_whom})",
        least.trials
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
