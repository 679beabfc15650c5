//! Reduces a station to the devices that some sources need.

use std::collections::BTreeSet;

use super::StationConfig;
use crate::scene::SourceId;

/// The devices of a station.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum DevicePart {
    Stylus,
    /// Lines, by their number.
    Lines(usize),
    Microphone,
    Camera,
    Flash,
}

impl StationConfig {
    /// This station with only those parts that a scan of `sources` needs: their devices and cuts
    /// and, so that scans
    /// are detected, one device that shows contact: of those needed, if one does, else the stylus,
    /// else lines, else the microphone.
    pub fn only(mut self, sources: &[SourceId]) -> Self {
        self.detection.cuts.retain(|cut| sources.contains(&cut.source));
        let cuts = &self.detection.cuts;
        let mut parts: BTreeSet<DevicePart> =
            cuts.iter().filter_map(|cut| self.part_of(&cut.stream)).collect();
        if parts.contains(&DevicePart::Flash) {
            parts.insert(DevicePart::Camera);
            // The stylus switches the light where the camera cannot.
            let flash = self.camera.as_ref().and_then(|camera| camera.flash.as_ref());
            if flash.is_some_and(|flash| flash.control.is_none()) && self.stylus.is_some() {
                parts.insert(DevicePart::Stylus);
            }
        }
        let groups = self.detection.groups.iter().flatten();
        let contact: BTreeSet<DevicePart> =
            groups.filter_map(|(stream, _)| self.part_of(stream)).collect();
        if parts.is_disjoint(&contact) {
            // The stylus comes first, then lines, then the microphone.
            parts.extend(contact.first());
        }
        let mut groups = std::mem::take(&mut self.detection.groups);
        let kept = |stream: &SourceId| self.part_of(stream).is_some_and(|p| parts.contains(&p));
        groups.retain(|group| group.iter().all(|(stream, _)| kept(stream)));
        self.detection.groups = groups;
        self.stylus = self.stylus.filter(|_| parts.contains(&DevicePart::Stylus));
        let mut number = 0..;
        self.lines.retain(|_| number.next().is_some_and(|n| parts.contains(&DevicePart::Lines(n))));
        self.microphone = self.microphone.filter(|_| parts.contains(&DevicePart::Microphone));
        self.camera = self.camera.filter(|_| parts.contains(&DevicePart::Camera));
        if let Some(camera) = &mut self.camera {
            camera.flash = camera.flash.take().filter(|_| parts.contains(&DevicePart::Flash));
        }
        self.by_t_star.retain(|source| sources.contains(source));
        self
    }

    /// The device that makes a stream.
    fn part_of(&self, stream: &SourceId) -> Option<DevicePart> {
        let camera = self.camera.as_ref();
        let flash = camera.and_then(|camera| camera.flash.as_ref());
        let of_stylus = |of: &super::StylusConfig| of.streams.iter().any(|w| w.id == *stream);
        let of_lines = |of: &super::LinesConfig| of.streams.iter().any(|s| s.id == *stream);
        if self.stylus.as_ref().is_some_and(of_stylus) {
            Some(DevicePart::Stylus)
        } else if let Some(number) = self.lines.iter().position(of_lines) {
            Some(DevicePart::Lines(number))
        } else if self.microphone.as_ref().is_some_and(|of| of.stream == *stream) {
            Some(DevicePart::Microphone)
        } else if camera.is_some_and(|of| of.source == *stream) {
            Some(DevicePart::Camera)
        } else {
            flash.is_some_and(|of| of.source == *stream).then_some(DevicePart::Flash)
        }
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
