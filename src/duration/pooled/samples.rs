//! What `pooled` looks at: trials of equal length, channel by channel, at a rate that it needs.

use std::ops::Range;

use crate::trial::Series;

/// Q trials of L frames of each channel.
#[derive(Clone, Debug)]
pub struct Samples {
    /// Q.
    pub trials: usize,
    /// L, frames of each trial.
    pub frames: usize,
    /// For each channel the trials one after the other: frame i of trial q at q·L + i.
    pub channels: Vec<Vec<f32>>,
}

impl Samples {
    /// Frames `range` of each trial, of which every `step`-th is kept.
    ///
    /// Frames are left out, not averaged: the dependence of two samples at a lag that is kept is
    /// then what it was, only lags in between are no longer seen.
    ///
    /// # Panics
    /// If a trial is shorter than `range`, or has fewer channels than the first.
    pub fn every(step: usize, range: Range<usize>, series: &[Series]) -> Self {
        let channels = series.first().map_or(0, Series::channels);
        let channel = |c: usize| -> Vec<f32> {
            (series.iter())
                .flat_map(|s| {
                    let frames = &s.samples()[range.start * channels..range.end * channels];
                    frames.iter().skip(c).step_by(channels * step)
                })
                .copied()
                .collect()
        };
        Self {
            trials: series.len(),
            frames: range.len().div_ceil(step),
            channels: (0..channels).map(channel).collect(),
        }
    }
}
