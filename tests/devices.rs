//! `surfaced devices` on whatever machine this is.

use assert_cmd::Command;
use serde_json::Value;

#[test]
fn devices_are_listed_by_kind_and_what_is_left_out_is_said() {
    let output =
        Command::cargo_bin("surfaced").unwrap().args(["devices", "--json"]).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    // Also where ALSA has plugins of sound systems that do not run, which complain by themselves.
    assert_eq!(said, "");
    let listed: Value = serde_json::from_slice(&output.stdout).unwrap();
    let kinds = [
        ("serial_ports", true),
        ("microphones", cfg!(feature = "microphone")),
        ("cameras", cfg!(feature = "camera")),
    ];
    for (kind, built) in kinds {
        assert_eq!(listed[kind]["built"], built, "{kind}");
        assert!(listed[kind]["devices"].is_array());
        let problem = listed[kind]["problem"].as_str().unwrap_or_default();
        let says_how = ["--features live", "libasound2-dev"].map(|part| problem.contains(part));
        assert_eq!(says_how, [!built; 2], "{kind}");
    }
    let microphones = listed["microphones"]["devices"].as_array().unwrap();
    assert!(microphones.iter().all(|microphone| microphone["id"] != "null"));
}

#[test]
fn without_json_stdout_is_a_table_for_people() {
    let output = Command::cargo_bin("surfaced").unwrap().arg("devices").output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}");
    for kind in ["serial ports:", "microphones:", "cameras:"] {
        assert!(said.contains(kind), "{said}");
    }
}
