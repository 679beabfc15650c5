//! A station with no more devices than some sources need.

use super::StationConfig;
use crate::scene::SourceId;

impl StationConfig {
    /// This station with what a scan of `sources` needs: their devices and cuts and, so that scans
    /// are found by themselves, one device that shows contact: of those needed, if one does, else
    /// the stylus, else the microphone.
    pub fn only(mut self, sources: &[SourceId]) -> Self {
        let cuts = &mut self.detection.cuts;
        cuts.retain(|cut| sources.contains(&cut.source));
        let needed = |stream: &SourceId| cuts.iter().any(|cut| cut.stream == *stream);
        let groups = &mut self.detection.groups;
        let shows = |stream: &SourceId| groups.iter().flatten().any(|(of, _)| of == stream);
        if let Some(camera) = &mut self.camera {
            camera.flash = camera.flash.take().filter(|flash| needed(&flash.source));
        }
        self.camera =
            self.camera.take().filter(|camera| camera.flash.is_some() || needed(&camera.source));
        // The stylus switches the light where the camera cannot.
        let light = (self.camera.as_ref().and_then(|camera| camera.flash.as_ref()))
            .is_some_and(|flash| flash.control.is_none());
        let stylus_shows =
            self.stylus.as_ref().is_some_and(|s| s.streams.iter().any(|w| shows(&w.id)));
        let microphone_shows = self.microphone.as_ref().is_some_and(|m| shows(&m.stream));
        let by_stylus = |s: &super::StylusConfig| light || s.streams.iter().any(|w| needed(&w.id));
        let by_microphone = |m: &super::MicrophoneConfig| needed(&m.stream);
        let stylus_needed = self.stylus.as_ref().is_some_and(by_stylus);
        let microphone_needed = self.microphone.as_ref().is_some_and(by_microphone);
        let found = stylus_needed && stylus_shows || microphone_needed && microphone_shows;
        let keep_stylus = stylus_needed || !found && stylus_shows;
        let keep_microphone = microphone_needed || !found && !stylus_shows && microphone_shows;
        self.stylus = self.stylus.filter(|_| keep_stylus);
        self.microphone = self.microphone.filter(|_| keep_microphone);
        let left = |stream: &SourceId| {
            self.microphone.as_ref().is_some_and(|m| m.stream == *stream)
                || (self.stylus.iter()).any(|s| s.streams.iter().any(|w| w.id == *stream))
        };
        groups.retain(|group| group.iter().all(|(stream, _)| left(stream)));
        self.by_t_star.retain(|source| sources.contains(source));
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn only(names: &[&str]) -> StationConfig {
        let sources: Vec<SourceId> =
            names.iter().map(|name| SourceId::new(name).unwrap()).collect();
        StationConfig::embedded().only(&sources)
    }

    fn devices(config: &StationConfig) -> [bool; 3] {
        [config.stylus.is_some(), config.microphone.is_some(), config.camera.is_some()]
    }

    #[test]
    fn no_device_is_opened_that_is_not_needed() {
        let sound = only(&["mi1", "mi2"]);
        assert_eq!(devices(&sound), [false, true, false], "the sound itself shows contact");
        assert_eq!(sound.detection.groups.len(), 1);
        assert_eq!(sound.detection.cuts.len(), 2);
        let forces = only(&["fr"]);
        assert_eq!(devices(&forces), [true, false, false]);
        assert_eq!(forces.detection.cuts.len(), 1);
        let picture = only(&["ca1"]);
        assert_eq!(devices(&picture), [true, false, true], "the stylus shows contact");
        assert!(picture.camera.unwrap().flash.is_none());
        let flash = only(&["ca2", "mi2"]);
        assert_eq!(devices(&flash), [true, true, true], "the stylus switches the light");
    }

    #[test]
    fn all_sources_need_the_whole_station() {
        let all = StationConfig::embedded();
        let sources: Vec<_> = all.detection.cuts.iter().map(|cut| cut.source.clone()).collect();
        assert_eq!(all.clone().only(&sources), all);
    }
}
