//! A program whose stderr is closed, full or unread continues, and exits as it should; so does one
//! that is to outlive its terminal.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::os::fd::OwnedFd;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

use serialport::{SerialPort, TTYPort};

use crate::bench::{Bench, SCANNED, synthetic, trial};

/// A pipe that nobody reads any more.
fn closed() -> Stdio {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    OwnedFd::from(writer).into()
}

fn full() -> Stdio {
    File::options().write(true).open("/dev/full").unwrap().into()
}

fn surfaced(args: &[&str], stderr: Stdio) -> Output {
    Command::new(env!("CARGO_BIN_EXE_surfaced"))
        .args(args)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(stderr)
        .spawn()
        .and_then(|child| child.wait_with_output())
        .unwrap()
}

/// Four trials by the expert and two by a user, in a folder of this one.
fn small_dataset(dir: &Path) -> String {
    let data = dir.join("data").to_str().unwrap().to_string();
    let synth = ["synth", &data, "--surfaces", "2", "--trials", "2", "--users", "1"];
    assert!(surfaced(&synth, full()).status.success());
    data
}

/// How a program ends, within `limit_s` seconds.
fn end_of(child: &mut Child, limit_s: u64, mut meanwhile: impl FnMut()) -> ExitStatus {
    let began = Instant::now();
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return status;
        }
        if began.elapsed().as_secs() >= limit_s {
            child.kill().unwrap();
            panic!("it does not end");
        }
        meanwhile();
    }
}

#[test]
fn replay_and_eval_print_their_json() {
    let dir = tempfile::tempdir().unwrap();
    let data = &small_dataset(dir.path());
    for stderr in [closed, full] {
        let replay =
            ["replay", data, "--protocol", "expert-vs-users", "--method", "reference", "--json"];
        let output = surfaced(&replay, stderr());
        assert!(output.status.success(), "{:?}", output.status);
        assert_eq!(String::from_utf8(output.stdout).unwrap().lines().count(), 2);
        let eval =
            ["eval", data, "--protocol", "expert-vs-users", "--method", "reference", "--json"];
        let output = surfaced(&eval, stderr());
        assert!(output.status.success(), "{:?}", output.status);
        let document: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(document["queries"], 2);
    }
    let wrong = surfaced(&["eval", "/no/such/folder", "--protocol", "expert-vs-users"], full());
    assert_eq!(wrong.status.code(), Some(1));
}

#[test]
fn a_station_names_scans_whatever_becomes_of_its_log() {
    let data = synthetic(1.5);
    for stderr in [closed(), full(), unread()] {
        let mut bench = Bench::new();
        let library = bench.library(&data);
        let args = ["run", "--library", library.to_str().unwrap(), "--method", "reference"];
        let mut run = bench.surfaced_with(&args, stderr);
        let mut fake = bench.stylus();
        fake.wait_for_start();
        let seconds = bench.play(&fake, &trial(&data, 1, SCANNED), 1.5);
        fake.serve(seconds);
        assert_eq!(run.line(&mut fake)["surface"], data.surfaces()[1]);
        run.signal("TERM");
        assert_eq!(run.end(&mut fake).code(), Some(0));
    }
}

#[test]
fn a_reader_of_json_who_stalls_does_not_hold_up_the_end() {
    let data = synthetic(0.8);
    let mut bench = Bench::new();
    let library = bench.library(&data);
    let mut child = Command::new(env!("CARGO_BIN_EXE_surfaced"))
        .args(["run", "--json", "--method", "reference", "--library"])
        .arg(&library)
        .arg("--config")
        .arg(bench.path("station.toml"))
        .arg("--stylus")
        .arg(bench.path("stylus"))
        .stdin(Stdio::null())
        .stdout(unread())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut fake = bench.stylus();
    fake.wait_for_start();
    let seconds = bench.play(&fake, &trial(&data, 0, SCANNED), 0.8);
    fake.serve(seconds + 1.0);
    assert!(Command::new("kill").arg(child.id().to_string()).status().unwrap().success());
    let status = end_of(&mut child, 5, || fake.obey());
    assert_eq!(status.code(), Some(0));
}

#[test]
fn a_replay_whose_results_nobody_reads_ends_in_time_all_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let data = &small_dataset(dir.path());
    let mut child = Command::new(env!("CARGO_BIN_EXE_surfaced"))
        .args(["replay", data, "--method", "reference", "--serve=127.0.0.1:0"])
        .stdin(Stdio::null())
        .stdout(unread())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // Before that, a signal ends it at once.
    while !catches_signals(child.id()) {
        std::thread::sleep(Duration::from_millis(20));
    }
    // Its first answer waits for a reader, and all else behind it.
    std::thread::sleep(Duration::from_secs(5));
    let began = Instant::now();
    assert!(Command::new("kill").arg(child.id().to_string()).status().unwrap().success());
    let status = child.wait().unwrap();
    assert!(began.elapsed() < Duration::from_secs(5), "it took {:?}", began.elapsed());
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert_eq!(status.code(), Some(3), "{said}");
    assert!(said.contains("did not end in time"), "{said}");
}

#[test]
fn a_hangup_ends_a_program_but_not_under_nohup() {
    let dir = tempfile::tempdir().unwrap();
    let data = &small_dataset(dir.path());
    // The test itself may run under `nohup`.
    let (plain, nohup) = (["env", "--default-signal=HUP"], ["nohup"]);
    for (under, outlives) in [(&plain[..], false), (&nohup[..], true)] {
        let mut child = Command::new(under[0])
            .args(&under[1..])
            .arg(env!("CARGO_BIN_EXE_surfaced"))
            .args(["replay", data, "--method", "reference", "--serve=127.0.0.1:0"])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let id = child.id().to_string();
        // Before it serves and looks out for signals, one ends it at once.
        let mut said = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        assert!(said.any(|line| line.starts_with("http://")));
        while !catches_signals(child.id()) {
            std::thread::sleep(Duration::from_millis(20));
        }
        let send = |name| {
            assert!(Command::new("kill").args(["-s", name, &id]).status().unwrap().success());
        };
        send("HUP");
        if outlives {
            std::thread::sleep(Duration::from_secs(1));
            assert!(child.try_wait().unwrap().is_none(), "it ended all the same");
            send("TERM");
        }
        // In order, whether or not its scans were named by then.
        let status = end_of(&mut child, 30, || std::thread::sleep(Duration::from_millis(20)));
        assert!(matches!(status.code(), Some(0 | 1 | 3)), "{status}");
    }
}

#[test]
fn a_service_says_that_a_hangup_reads_nothing_anew_and_goes_on_and_a_lost_terminal_ends_a_station()
{
    let dir = tempfile::tempdir().unwrap();
    let station = dir.path().join("station.toml");
    let lines = "format = 1\n[stylus]\npresent = false\n[[lines]]\nport = \"udp://127.0.0.1:0\"\n\
                 rate_hz = 100.0\n[lines.sources]\npull = [1]\n";
    std::fs::write(&station, lines).unwrap();
    let (_screen, terminal) = TTYPort::pair().unwrap();
    for is_service in [true, false] {
        let terminal = File::options().read(true).write(true).open(terminal.name().unwrap());
        let (ctty, stdin) = match is_service {
            true => ("--wait", Stdio::null()),
            false => ("--ctty", terminal.unwrap().into()),
        };
        let mut child = Command::new("env")
            .args(["--default-signal=HUP", "setsid", ctty, env!("CARGO_BIN_EXE_surfaced"), "run"])
            .args(["--config", station.to_str().unwrap(), "--library"])
            .arg(dir.path())
            .stdin(stdin)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let id = child.id();
        while !catches_signals(id) {
            std::thread::sleep(Duration::from_millis(20));
        }
        let send = |name| {
            let mut kill = Command::new("kill");
            assert!(kill.args(["-s", name, &id.to_string()]).status().unwrap().success());
        };
        send("HUP");
        let mut said = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        if is_service {
            assert!(
                said.any(|line| line.contains("SIGHUP: the configuration is read at the start"))
            );
            assert!(child.try_wait().unwrap().is_none(), "it ended all the same");
            send("TERM");
        }
        let status = end_of(&mut child, 30, || std::thread::sleep(Duration::from_millis(20)));
        assert_eq!(status.code(), Some(0));
        assert!(!said.any(|line| line.contains("SIGHUP")), "said once, and only by a service");
    }
}

/// Whether a process has a handler of SIGTERM, which is number 15.
fn catches_signals(id: u32) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{id}/status")).unwrap();
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
    u64::from_str_radix(caught.trim(), 16).unwrap() & (1 << 14) != 0
}

/// A pipe that is full, and whose reader has stalled.
fn unread() -> Stdio {
    use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
    use std::io::Write;
    let (reader, mut writer) = std::io::pipe().unwrap();
    let flags = fcntl_getfl(&writer).unwrap();
    fcntl_setfl(&writer, flags | OFlags::NONBLOCK).unwrap();
    while writer.write(&[b'.'; 4096]).is_ok() {}
    fcntl_setfl(&writer, flags).unwrap();
    // It stays open as long as the test runs.
    std::mem::forget(reader);
    OwnedFd::from(writer).into()
}
