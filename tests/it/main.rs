//! The tests of the library and of the program, but those that need a process or a service of their
//! own, which lie beside this folder.

#[path = "../common/bench.rs"]
mod bench;
#[path = "../common/mod.rs"]
mod common;

mod answers;
mod array_forms;
mod bad_input;
mod chart;
mod commands;
mod compared;
mod continuous;
mod cross_user;
mod curate;
mod desk;
mod drift;
mod duration;
mod edit;
mod ending;
mod engine;
mod forms;
mod golden;
mod hostile_numbers;
mod hsic_golden;
mod interrupted_import;
mod invariance;
mod library;
mod line_forms;
mod lines;
mod live_scan;
mod lmt108;
#[cfg(feature = "lossy")]
mod lossy_sounds;
mod mat_forms;
mod methods;
mod microphone;
mod model_file;
mod no_stderr;
mod openapi;
mod pages;
mod paper;
mod parquet_forms;
mod plan;
mod ready_model;
mod reload;
mod ring_and_replay;
mod roles;
mod run;
mod run_serve;
mod scene;
mod score;
mod serial;
mod serve;
mod serve_day;
mod serve_fuzz;
mod serve_hostile;
mod signals;
mod sound_forms;
mod station_config;
mod stress;
mod synth;
mod t_star;
mod table_doubts;
mod table_forms;
