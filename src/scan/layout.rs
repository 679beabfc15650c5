//! Which streams show contact, and which sources are cut from which streams.

use super::detect::{DetectorConfig, SensorKind};
use crate::scene::{Phase, SourceId};

/// How scans are detected, and what is cut for them.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// What is a tap, and what a drag.
    pub detector: DetectorConfig,
    /// Streams that show contact, by device: those of one group share one sample counter and one
    /// rate. The first group whose data arrive leads.
    pub groups: Vec<Vec<(SourceId, SensorKind)>>,
    /// The sources of a scan.
    pub cuts: Vec<CutFrom>,
}

/// A source of a scan, and the stream that it is cut from.
#[derive(Clone, Debug, PartialEq)]
pub struct CutFrom {
    /// The source.
    pub source: SourceId,
    /// Its stream.
    pub stream: SourceId,
    /// The part of the scan.
    pub phase: Phase,
    /// How many of the stream's channels are the source's: the first ones.
    pub channels: usize,
}

/// A command of a person or a program, which a detector does not overrule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScanCommand {
    /// A drag begins now; a scan in progress that was detected then ends by command alone.
    Begin,
    /// The scan in progress ends now.
    End,
}
