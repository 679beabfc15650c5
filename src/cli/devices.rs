//! `surfaced devices`: lists devices with permanent names and their problems. With `--watch`: shows
//! what a sensor of lines sends, and writes a configuration that fits it.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::{Done, Failure, show};
use crate::device::lines::{ColumnSurvey, LinesAddress, SURVEY_S, survey_of};
use crate::device::list::{self, ListedDevice};
use crate::printable::Printable;
use crate::station::config::fitting;

/// List serial ports, microphones and cameras with stable ids, and the problems of each
///
/// With --watch, show what a sensor of lines of numbers sends: rate, columns, ranges.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced devices\n  surfaced devices --json\n  \
                  surfaced devices --watch /dev/ttyACM0\n  \
                  surfaced devices --watch tcp://192.168.1.7:5000 --write station.toml\n\n\
                  Time: a second; with --watch, three seconds from the first line")]
pub(super) struct Args {
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
    /// Show what a sensor sends: a serial port (PORT@BAUD), tcp://HOST:PORT, udp://HOST:PORT (to
    /// listen there), or - for standard input
    #[arg(long, value_name = "PORT", allow_hyphen_values = true)]
    watch: Option<LinesAddress>,
    /// Write the configuration of a station with this sensor
    #[arg(long, value_name = "FILE", requires = "watch")]
    write: Option<PathBuf>,
}

/// The longest wait for the first line. Some boards restart when their port is opened.
pub(super) const SURVEY_PATIENCE: Duration = Duration::from_secs(10);

#[derive(serde::Serialize)]
struct Watched {
    port: String,
    /// Lines per second; `None` if that cannot be measured.
    rate_hz: Option<f64>,
    columns: Vec<ColumnSurvey>,
    first_lines: Vec<String>,
    /// Share of the lines that are rows, from 0 to 1.
    fitting_share: f64,
    remarks: Vec<String>,
    /// The reason why no configuration fits the sensor, and what to do.
    problem: Option<String>,
    configuration: Option<String>,
}

#[derive(serde::Serialize)]
struct DeviceClass {
    /// Whether this build has drivers for the class.
    built: bool,
    devices: Vec<ListedDevice>,
    /// The reason why devices may be missing from the list, and what to do.
    problem: Option<String>,
}

impl DeviceClass {
    fn of<E: std::fmt::Display>(listed: Result<Vec<ListedDevice>, E>) -> Self {
        let problem = listed.as_ref().err().map(ToString::to_string);
        Self { built: true, devices: listed.unwrap_or_default(), problem }
    }

    #[cfg(not(all(feature = "microphone", feature = "camera")))]
    fn left_out(feature: &str) -> Self {
        let problem = format!(
            "this build has no {feature}s; on Linux, build with `--features live`, or `--features \
             {feature}` (on Debian, first: apt-get install pkg-config libasound2-dev libclang-dev)"
        );
        Self { built: false, devices: Vec::new(), problem: Some(problem) }
    }
}

#[cfg(feature = "microphone")]
fn microphones() -> DeviceClass {
    let _hushed = HushedStderr::new();
    DeviceClass::of(crate::device::microphone::microphones())
}

/// Silences stderr until it is dropped: libraries behind ALSA's plugins, such as JACK's, report a
/// missing server there, but the list already shows this problem. Only for this command, in which
/// no other thread writes to stderr.
#[cfg(feature = "microphone")]
struct HushedStderr(Option<std::os::fd::OwnedFd>);

#[cfg(feature = "microphone")]
impl HushedStderr {
    /// If stderr cannot be saved, it stays open.
    fn new() -> Self {
        let kept = rustix::io::fcntl_dupfd_cloexec(std::io::stderr(), 3).ok();
        let null = std::fs::OpenOptions::new().write(true).open("/dev/null").ok();
        let hushed = kept.zip(null).filter(|(_, null)| rustix::stdio::dup2_stderr(null).is_ok());
        Self(hushed.map(|(kept, _)| kept))
    }
}

#[cfg(feature = "microphone")]
impl Drop for HushedStderr {
    fn drop(&mut self) {
        if let Some(kept) = &self.0 {
            // If stderr cannot be restored, there is nowhere to report it.
            let _ = rustix::stdio::dup2_stderr(kept);
        }
    }
}

#[cfg(not(feature = "microphone"))]
fn microphones() -> DeviceClass {
    DeviceClass::left_out("microphone")
}

#[cfg(feature = "camera")]
fn cameras() -> DeviceClass {
    DeviceClass::of(crate::device::camera::cameras())
}

#[cfg(not(feature = "camera"))]
fn cameras() -> DeviceClass {
    DeviceClass::left_out("camera")
}

fn watch(address: &LinesAddress, args: &Args) -> Done {
    say!("watching {address}, for {SURVEY_S} s; leave the sensor at rest");
    let survey = survey_of(address, SURVEY_PATIENCE).map_err(Failure::Failed)?;
    let fitting = fitting(address, &survey);
    let watched = Watched {
        port: address.to_string(),
        rate_hz: survey.rate_hz().ok(),
        columns: survey.columns(),
        first_lines: survey.first_lines.clone(),
        fitting_share: survey.fitting_share(),
        remarks: survey.remarks(),
        problem: fitting.as_ref().err().cloned(),
        configuration: fitting.as_ref().ok().cloned(),
    };
    show::result(args.json, &watched, show_watched);
    watched.remarks.iter().for_each(|remark| say!("{remark}"));
    let configuration = fitting.map_err(|why| Failure::Failed(format!("{address}: {why}")))?;
    let Some(file) = &args.write else {
        show::next(&format!("surfaced devices --watch {address} --write station.toml"));
        return Ok(());
    };
    write_new(file, &configuration)?;
    show::wrote(&[file]);
    show::next(&format!(
        "surfaced enroll LABEL --config {0} --library my-library for each surface, then surfaced \
         run --config {0} --library my-library",
        show::quoted(file)
    ));
    Ok(())
}

fn write_new(path: &Path, text: &str) -> Done {
    let failed = |error: std::io::Error| match error.kind() {
        std::io::ErrorKind::AlreadyExists => {
            Failure::at(path, "it is there already and was left as it is; name another file")
        }
        _ => Failure::at(path, error),
    };
    let mut file = std::fs::File::create_new(path).map_err(failed)?;
    file.write_all(text.as_bytes()).map_err(failed)
}

fn show_watched(Watched { port, rate_hz, columns, first_lines, .. }: &Watched) {
    first_lines.iter().for_each(|line| result!("  > {}", Printable(line)));
    if columns.is_empty() {
        return;
    }
    let rate = rate_hz.map_or("an unknown rate".to_string(), |rate_hz| format!("{rate_hz} Hz"));
    result!("{port}: lines of {} at {rate}", show::counted(columns.len(), "column"));
    for (at, column) in columns.iter().enumerate() {
        let name = column.name.as_deref().unwrap_or_default();
        let range = match (column.lowest, column.highest, column.counts) {
            (_, _, Some(counts)) => format!("counts {counts}"),
            (Some(low), _, _) if column.constant => format!("always {low}"),
            (Some(low), Some(high), _) => format!("{low} to {high}"),
            _ => "no numbers".into(),
        };
        result!("  {:>2}  {name:<10}  {range}", at + 1);
    }
}

pub(super) fn run(args: &Args) -> Done {
    if let Some(address) = &args.watch {
        return watch(address, args);
    }
    let classes = BTreeMap::from([
        ("serial_ports", DeviceClass::of(list::serial_ports())),
        ("microphones", microphones()),
        ("cameras", cameras()),
    ]);
    show::result(args.json, &classes, |classes| {
        classes.iter().rev().for_each(|(name, class)| show_class(name, class));
        show::next("surfaced enroll LABEL --library my-library");
    });
    let unlisted: Vec<_> = (classes.iter().rev())
        .filter(|(_, class)| class.built)
        .filter_map(|(name, class)| Some(format!("{}: {}", plain(name), class.problem.as_ref()?)))
        .collect();
    if unlisted.is_empty() { Ok(()) } else { Err(Failure::Failed(unlisted.join("; "))) }
}

fn plain(name: &str) -> String {
    name.replace('_', " ")
}

fn show_class(name: &str, class: &DeviceClass) {
    result!("{}:", plain(name));
    match &class.problem {
        Some(problem) => result!("  {problem}"),
        None if class.devices.is_empty() => result!("  none"),
        None => {}
    }
    for device in &class.devices {
        let ListedDevice { id, name, node, problem } = device;
        let now = node.as_ref().filter(|node| *node != id);
        let node = now.map(|node| format!(" (now {node})")).unwrap_or_default();
        result!("  {id}{node}: {}", name.replace('\n', ", "));
        if let Some(problem) = problem {
            result!("    ! {problem}");
        }
    }
}
