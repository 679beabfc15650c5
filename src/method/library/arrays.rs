//! A library of recordings that are in memory already.

use super::{Entry, Library};
use crate::scene::{Scene, SceneError, SourceId};
use crate::trial::{Series, Trial, TrialKey};

impl Library {
    /// A library in memory. Its trials have one source, a series, and all have the channels and the rate
    /// of the first. `band_hz` is that of [`Scene::of_series`].
    ///
    /// # Errors
    /// If there are no trials, if channels or rates differ, and the errors of [`Scene::of_series`].
    pub fn of_series(
        source: &SourceId,
        band_hz: Option<(f64, f64)>,
        trials: impl IntoIterator<Item = (TrialKey, Series)>,
    ) -> Result<Self, SceneError> {
        let trials: Vec<(TrialKey, Series)> = trials.into_iter().collect();
        let like = |series: &Series| (series.channels(), series.rate_hz());
        let Some((channels, rate_hz)) = trials.first().map(|(_, first)| like(first)) else {
            return Err(SceneError("there are no trials".into()));
        };
        if let Some((key, other)) = trials.iter().find(|(_, s)| like(s) != (channels, rate_hz)) {
            let (found, found_hz) = like(other);
            return Err(SceneError(format!(
                "{key} has {found} channels at {found_hz} Hz; expected {channels} at {rate_hz} Hz, like \
                 the first trial"
            )));
        }
        let scene = Scene::of_series(source.clone(), channels, rate_hz, band_hz)?;
        let entry = |(key, series)| Entry::in_memory(Trial::of_series(key, source.clone(), series));
        let mut entries: Vec<Entry> = trials.into_iter().map(entry).collect();
        entries.sort_by(|a, b| a.key.cmp(&b.key));
        Ok(Self { name: String::new(), scene, entries, synthetic: false, remarks: Vec::new() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn library(rates: [f64; 2], channels: [usize; 2]) -> Result<Library, SceneError> {
        let trials = (1..).zip(rates).zip(channels).map(|((number, rate_hz), channels)| {
            let series = Series::new(rate_hz, channels, vec![0.5; 12]).unwrap();
            (TrialKey::new("oak", "ann", 3 - number), series)
        });
        Library::of_series(&SourceId::new("signal").unwrap(), Some((5.0, 50.0)), trials)
    }

    #[test]
    fn trials_are_sorted_and_have_one_source_of_one_shape() {
        let library_of_two = library([100.0; 2], [2; 2]).unwrap();
        let numbers: Vec<u32> = library_of_two.entries.iter().map(|e| e.key.number).collect();
        assert_eq!(numbers, [1, 2]);
        assert_eq!(library_of_two.scene.get("signal").unwrap().channels, 2);
        let why = library([100.0, 200.0], [2; 2]).unwrap_err().to_string();
        assert!(why.contains("2 channels at 200 Hz; expected 2 at 100 Hz"), "{why}");
        assert!(library([100.0; 2], [2, 3]).is_err());
        let why = library([80.0; 2], [1; 2]).unwrap_err().to_string();
        assert!(why.contains("lower its upper end to 40"), "{why}");
    }
}
