//! The whole state of a station, as a request gets it and as a stream of events begins.

use serde::Serialize;

use super::state::State;
use crate::device::camera::{CameraView, Viewfinder};
use crate::outputs::OutputView;
use crate::ring::Counts;
use crate::scan::StreamMeter;
use crate::scene::SourceId;

/// All that is known now.
#[derive(Serialize)]
pub struct Whole<'a> {
    #[serde(flatten)]
    state: &'a State,
    /// Whether the station keeps scans for a library.
    enrolls: bool,
    /// The camera, if there is one.
    camera: Option<CameraView>,
    streams: Vec<StreamView>,
    /// How the outputs are that answers go to.
    outputs: Vec<OutputView>,
}

impl<'a> Whole<'a> {
    /// What the parts say now.
    pub fn of(
        state: &'a State,
        enrolls: bool,
        viewfinder: &Option<Viewfinder>,
        meters: &[StreamMeter],
        outputs: Vec<OutputView>,
    ) -> Self {
        let camera = viewfinder.as_ref().map(Viewfinder::view);
        Self { state, enrolls, camera, streams: views(meters), outputs }
    }
}

/// What one stream carries.
#[derive(Debug, Serialize)]
struct StreamView {
    source: SourceId,
    device: String,
    #[serde(flatten)]
    counts: Counts,
}

/// What all streams carry.
#[derive(Serialize)]
pub struct StreamsEvent {
    streams: Vec<StreamView>,
}

impl StreamsEvent {
    /// What these meters say now.
    pub fn of(meters: &[StreamMeter]) -> Self {
        Self { streams: views(meters) }
    }
}

fn views(meters: &[StreamMeter]) -> Vec<StreamView> {
    let view = |meter: &StreamMeter| StreamView {
        source: meter.id.clone(),
        device: meter.device.clone(),
        counts: meter.counts(),
    };
    meters.iter().map(view).collect()
}
