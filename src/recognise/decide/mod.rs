//! What a ranking is taken for: when an answer is settled, whether a surface is unknown, which
//! sources no comparison should see.

pub mod conformal;
pub mod dead_sensor;
pub mod interval;
pub mod settle;
