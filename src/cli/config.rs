//! `surfaced config`: checks the configuration of a station.

use std::path::PathBuf;

use clap::Subcommand;

use super::show::{counted, joined, listed};
use super::{Done, Failure};
use crate::outputs;
use crate::scan::CutFrom;
use crate::scene::SourceId;
use crate::station::Continuous;
use crate::station::config::{OutputsConfig, StationConfig};

/// Check the configuration of a station
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced config check station.toml\n\nTime: immediate")]
pub(super) struct Args {
    #[command(subcommand)]
    command: ConfigCommand,
}

#[derive(Subcommand)]
enum ConfigCommand {
    /// Read a configuration as `run` does, and print what was understood
    ///
    /// No device is opened and nothing is sent. A mistake is reported with its line, and ends the
    /// command with code 2.
    Check {
        /// The station's configuration
        file: PathBuf,
    },
}

pub(super) fn run(args: &Args) -> Done {
    let ConfigCommand::Check { file } = &args.command;
    let config = super::config(Some(file))?;
    outputs::check(&config.outputs)?;
    let devices = devices(&config);
    let is_usable = devices.iter().any(|(_, is_built, _)| *is_built);
    let devices = devices.into_iter().map(|(name, is_built, what)| match is_built {
        true => (name, what),
        false => (name, format!("{what}; this build has no driver for it")),
    });
    for (name, what) in devices.chain(other(&config)) {
        result!("{name:<10} {what}");
    }
    match is_usable {
        true => Ok(()),
        false => Err(Failure::usage_at(file, "no device is configured that this build can use")),
    }
}

/// The devices: the kind of each, whether this build can use it, and what it gives.
fn devices(config: &StationConfig) -> Vec<(&'static str, bool, String)> {
    let mut all = Vec::new();
    if let Some(stylus) = &config.stylus {
        let made = sources(config, stylus.streams.iter().map(|stream| &stream.id));
        all.push(("stylus", true, format!("{} at {} Hz: {made}", stylus.port, stylus.rate_hz)));
    }
    all.extend(config.lines.iter().map(|lines| {
        let rate =
            lines.rate_hz.map_or("a rate to be measured".into(), |rate| format!("{rate} Hz"));
        let made = sources(config, lines.streams.iter().map(|stream| &stream.id));
        ("lines", true, format!("{} at {rate}: {made}", lines.address))
    }));
    if let Some(microphone) = &config.microphone {
        let made = sources(config, [&microphone.stream]);
        let what = format!("{}: {made}", microphone.device);
        all.push(("microphone", cfg!(feature = "microphone"), what));
    }
    if let Some(camera) = &config.camera {
        let flash = camera.flash.as_ref().map(|of| &of.source);
        let made = sources(config, [&camera.source].into_iter().chain(flash));
        let every_ms = camera.every.as_millis();
        let what = format!("{}, a picture every {every_ms} ms: {made}", camera.device);
        all.push(("camera", cfg!(feature = "camera"), what));
    }
    all
}

/// The sources that are cut from streams, with their channels.
fn sources<'a>(config: &StationConfig, streams: impl IntoIterator<Item = &'a SourceId>) -> String {
    let streams: Vec<_> = streams.into_iter().collect();
    let cuts = config.detection.cuts.iter().filter(|cut| streams.contains(&&cut.stream));
    listed(cuts.map(|CutFrom { source, channels, .. }| {
        format!("{source} ({})", counted(*channels, "channel"))
    }))
}

/// The settings besides devices: a name and a text each.
fn other(config: &StationConfig) -> Vec<(&'static str, String)> {
    let groups = config.detection.groups.iter();
    let contact = groups.map(|group| listed(group.iter().map(|(stream, _)| stream)));
    let library = match &config.library {
        Some(folder) if folder.is_dir() => folder.display().to_string(),
        Some(folder) => format!("{}, which is no folder", folder.display()),
        None => "none; give --library".into(),
    };
    let named = match config.continuous() {
        None => "each drag, at its end".into(),
        Some(Continuous { hop_s, expected_stay_s }) => format!(
            "the surface while something moves, every {hop_s} s; it is expected to stay for \
             {expected_stay_s} s"
        ),
    };
    vec![
        ("named", named),
        ("contact", format!("shown by {}", joined(contact, ", or else "))),
        ("library", library),
        ("outputs", of_outputs(&config.outputs)),
        ("page", format!("http://{}, with --serve", config.serve)),
    ]
}

fn of_outputs(config: &OutputsConfig) -> String {
    let OutputsConfig { station, http, mqtt, alerts } = config;
    let of_alerts = alerts.iter().map(|alert| {
        let (http, coil) = (alert.http.iter(), alert.coil.iter());
        let to: Vec<_> =
            http.map(ToString::to_string).chain(coil.map(ToString::to_string)).collect();
        match to.is_empty() {
            true => format!("alert {}", alert.name),
            false => format!("alert {} to {}", alert.name, joined(to, " and ")),
        }
    });
    let all = http.iter().map(ToString::to_string).chain(mqtt.iter().map(ToString::to_string));
    let all = listed(all.chain(of_alerts));
    if all.is_empty() { "none".into() } else { format!("{all}, as {station}") }
}
