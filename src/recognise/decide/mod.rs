//! Decisions about a scan: when its answer is settled, how long the scan must last, whether its
//! surface is unknown, and which sources are left out because their sensor is dead.

pub mod conformal;
pub mod dead_sensor;
pub mod interval;
pub mod scan_time;
pub mod settle;
