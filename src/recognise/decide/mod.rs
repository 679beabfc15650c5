//! Decisions on a ranking: when an answer is settled, how long a scan must last, whether a
//! surface is unknown, which sources no comparison should see.

pub mod conformal;
pub mod dead_sensor;
pub mod interval;
pub mod scan_time;
pub mod settle;
