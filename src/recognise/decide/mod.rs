//! Decisions about a scan: when its answer is settled, how long the scan must last, whether its
//! surface is unknown, and which sources are left out because their sensor is dead.

pub(super) mod conformal;
pub(super) mod dead_sensor;
pub(super) mod interval;
pub(super) mod scan_time;
pub(super) mod settle;
