//! Sensors that are dead, stuck or wired the wrong way.

use super::setting::{Setting, analog, each_series, many_channels, sensed};
use crate::scene::SourceSpec;
use crate::seed::uniform;
use crate::trial::{Image, Signal, Trial};

/// A number of sensors give nothing: series of zeros, black pictures.
pub fn dead(trial: &mut Trial, setting: &mut Setting<'_>) {
    for signal in picked(trial, setting, sensed) {
        match signal {
            Signal::Series(series) => series.view_mut().fill(0.0),
            Signal::Image(image) => {
                let black = vec![0; image.rgb().len()];
                if let Ok(black) = Image::new(Image::COLS, Image::ROWS, black) {
                    *image = black;
                }
            }
        }
    }
}

/// A number of sensors hold the value that they began with.
pub fn stuck(trial: &mut Trial, setting: &mut Setting<'_>) {
    for signal in picked(trial, setting, analog) {
        if let Signal::Series(series) = signal {
            let first = series.view().row(0).to_owned();
            series.view_mut().rows_mut().into_iter().for_each(|mut row| row.assign(&first));
        }
    }
}

/// Channels in turn: the second is taken for the first, and so on.
pub fn swapped(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, many_channels, |_, series, _, by| {
        for mut row in series.view_mut().rows_mut() {
            if let Some(row) = row.as_slice_mut() {
                let by = by as usize % row.len();
                row.rotate_left(by);
            }
        }
    });
}

/// As many of the signals as the level says, picked at random; one at least is left alone.
fn picked<'t>(
    trial: &'t mut Trial,
    setting: &mut Setting<'_>,
    touches: fn(&SourceSpec) -> bool,
) -> Vec<&'t mut Signal> {
    let rng = &mut setting.rng;
    let all = trial.signals.len();
    let mut signals: Vec<(f64, &mut Signal)> = (trial.signals.iter_mut())
        .filter(|(id, _)| setting.scene.get(id.as_str()).is_some_and(touches))
        .map(|(_, signal)| (uniform(rng), signal))
        .collect();
    signals.sort_by(|a, b| a.0.total_cmp(&b.0));
    signals.truncate((setting.level as usize).min(all.saturating_sub(1)));
    signals.into_iter().map(|(_, signal)| signal).collect()
}
