//! Tables that have two readings, gaps or mixed units: refused, or said.

use crate::common::{open, says, temp, write_file};
use crate::plan::{said, surfaced, text};
use crate::table_forms::{Imported, ROWS, import, table, value};
use surfaced::library::About;
use surfaced::trial::Signal;

#[test]
fn what_has_two_readings_is_refused_and_shows_both() {
    let t = |row: fn(usize) -> String| (0..50).map(row).collect::<String>();
    for (text, args, parts) in [
        (
            "ax,ay\n".to_string() + &t(|i| format!("{i},5,{i},25\n")),
            &["--rate", "9"][..],
            &["decimal marks or"][..],
        ),
        ("t;x\n".to_string() + &t(|i| format!("0,{i:03};1.234\n")), &[], &["may be 1.234 or 1234"]),
        (
            "time,x\n".to_string() + &t(|i| format!("{},1.5\n", 100 * i)),
            &[],
            &["0.01 rows a second in s, 10 in ms"],
        ),
        ("time,x\n".to_string() + &t(|i| format!("{i},{i}.5\n")), &[], &["milliseconds or rows"]),
        (
            "t,x\n".to_string()
                + &t(|i| format!("0.{:02},{}\n", i, if i == 7 { "0.5g" } else { "1" })),
            &[],
            &["line 9, column `x`: `0.5g`"],
        ),
        (
            "t,x\n".to_string() + &t(|i| format!("0.{i:02},1\n")) + "1\n",
            &[],
            &["line 52 has 1 column"],
        ),
        (
            "ax,ay,az\n".to_string() + &t(|i| format!("{},5,{};\n", i * 7 % 11, i * 5 % 13)),
            &["--rate", "9"],
            &["column `az` holds `0;`", "--source"],
        ),
        (
            "ax,label\n".to_string()
                + &t(|i| format!("{},{}\n", i * 7 % 11, if i < 25 { "oak" } else { "felt" })),
            &["--rate", "9"],
            &["column `label` holds `oak` and `felt`", "--surface 'label'"],
        ),
        (
            "t,x\n".to_string() + &t(|i| format!("{}.0{},{i}\n", i / 10, i % 10)),
            &[],
            &["times", "time"],
        ),
        ("PK\u{3}\u{4}".to_string(), &["--rate", "9"], &["Excel workbook"]),
        (
            "time,variable,x\n".to_string()
                + &t(|i| {
                    format!("0.{i:02},{},{}\n", if i < 25 { "ax" } else { "force" }, i * 7 % 11)
                }),
            &["--rate", "9"],
            &["column `variable`", "holds the value (`ax`, `force`, …)", "pivot"],
        ),
        (
            "time,was,x\n".to_string()
                + &t(|i| format!("0.{:02},{},{}\n", i / 3, ["ax", "ay", "fx"][i % 3], i * 7 % 11)),
            &[],
            &["column `was`", "pivot"],
        ),
        (
            "time,sensor,x,y\n".to_string()
                + &t(|i| format!("0.{i:02},{},{}.5,1\n", ["acc", "gyro"][i % 2], i * 7 % 11)),
            &[],
            &["column `sensor`", "holds the values (`acc`, `gyro`, …)", "pivot"],
        ),
    ] {
        let imported = import("oak/1.csv", text.as_bytes(), args);
        assert_ne!(imported.output.status.code(), Some(0), "{text:.60}: {}", imported.said());
        assert!(!imported.out.exists());
        if parts[0] != "times" {
            says(&imported.said(), parts);
        }
    }
}

#[test]
fn gaps_are_filled_marked_or_cut() {
    let form = |bad: fn(usize) -> bool| {
        table("t,ax\n", move |i, [x, ..]| {
            format!("{:.2},{}", i as f64 / 100.0, if bad(i) { "" } else { &x })
        })
    };
    let few = import("oak/1.csv", form(|i| (100..105).contains(&i)).as_bytes(), &[]);
    says(&few.said(), &["filled in by straight lines: 5 values"]);
    let folder = few.library().entries[0].places()[0].to_path_buf();
    let about = About::read(&folder).unwrap();
    assert_eq!(about.interpolated["ax"], "5 of 300: 101-105");
    let many = form(|i| (100..106).contains(&i));
    let cut = import("oak/1.csv", many.as_bytes(), &[]);
    let frames: Vec<usize> =
        cut.library().entries.iter().map(|e| e.load().unwrap().signals["ax"].frames()).collect();
    assert_eq!(frames, [100, 194], "{}", cut.said());
    let refused = import("oak/1.csv", many.as_bytes(), &["--gaps", "error"]);
    says(&refused.said(), &["gap of more than 5 samples after its row 100"]);
    // A gap in time, of years by a broken stamp.
    let pause = table("timestamp,ax\n", |i, [x, ..]| {
        let ns = 1_700_000_000_000_000_000_u64 + i as u64 * 10_000_000;
        format!("{},{x}", if i < 20 { i as u64 * 10_000_000 } else { ns })
    });
    let cut = import("oak/1.csv", pause.as_bytes(), &[]);
    let frames: Vec<usize> =
        cut.library().entries.iter().map(|e| e.load().unwrap().signals["ax"].frames()).collect();
    assert_eq!(frames, [20, 280], "{}", cut.said());
}

#[test]
fn sensors_of_several_rates_in_one_table_keep_their_rows() {
    let form = |cells: fn(usize, [String; 3]) -> String| {
        table("time,ax,ay,force\n", move |i, xs| {
            format!("{:.3},{}", i as f64 / 100.0, cells(i, xs))
        })
    };
    // The force in every fourth row, or in rows of its own, which may come in batches.
    let joined =
        form(|i, [x, y, z]| format!("{x},{y},{}", if i % 4 == 1 { z } else { String::new() }));
    let apart = form(|i, [x, y, z]| match i % 4 {
        1 => format!("{x},{y},\n{:.3},,,{z}", i as f64 / 100.0 + 0.004),
        _ => format!("{x},{y},"),
    });
    let mut late: Vec<&str> = apart.lines().collect();
    late[1..].chunks_mut(10).for_each(|batch| batch.sort_by_key(|line| !line.contains(",,,")));
    let late = late.join("\n");
    let by_rate = joined.replace("time,", "place,");
    let given = ["--rate", "100", "--source", "a=ax,ay", "--source", "force=force"];
    for (text, args, is_alone) in [
        (&joined, &[][..], false),
        (&by_rate, &given, false),
        (&apart, &[], false),
        (&late, &[], false),
        (&apart, &["--source", "force=force"], true),
    ] {
        let imported = import("oak/1.csv", text.as_bytes(), args);
        let force = imported.series("force");
        let right: Vec<f32> = (0..75).map(|i| value(4 * i + 1, 2) as f32).collect();
        assert_eq!((force.rate_hz(), force.samples()), (25.0, &right[..]), "{}", imported.said());
        if !is_alone {
            let series = imported.series("a");
            let right = (0..ROWS).flat_map(|i| [value(i, 0) as f32, value(i, 1) as f32]);
            assert_eq!(
                (series.rate_hz(), series.samples()),
                (100.0, &right.collect::<Vec<_>>()[..])
            );
            says(&imported.said(), &["rows of their own"]);
        }
    }
}

#[test]
fn rows_that_come_late_are_sorted_and_infinities_are_missing_values() {
    let infinite = [77, 200];
    let text = table("time,ax\n", |i, [x, ..]| {
        // Two rows in twenty come after the next one.
        let place = [i + 1, i.saturating_sub(1)];
        let at = if i % 20 < 4 { place[i % 2] } else { i };
        let x = if at == i { x } else { format!("{:.3}", value(at, 0)) };
        let x = if infinite.contains(&at) { "-inf".into() } else { x };
        format!("{:.2},{x}", at as f64 / 100.0)
    });
    let imported = import("oak/1.csv", text.as_bytes(), &[]);
    let series = imported.series("ax");
    assert_eq!((series.frames(), series.rate_hz()), (ROWS, 100.0));
    for (row, x) in series.samples().iter().enumerate() {
        let right = infinite.contains(&row) || *x == value(row, 0) as f32;
        assert!(right, "row {row}: {x}");
    }
    says(
        &imported.said(),
        &["after rows of later times: 30 rows", "filled in by straight lines: 2 values"],
    );
}

#[test]
fn what_would_give_wrong_numbers_without_a_word_is_refused_or_said() {
    let plain = table("ax,ay,az\n", |_, [x, y, z]| format!("{x},{y},{z}"));
    let timed = |name: &str, time: fn(usize) -> String| {
        table(&format!("{name},ax,ay\n"), move |i, [x, y, _]| format!("{},{x},{y}", time(i)))
    };
    let two_tables = timed("time", |i| format!("{:.2}", i as f64 / 100.0))
        + &table("time,ax,ay,az\n", |i, [x, y, z]| {
            format!("{:.2},{x},{y},{z}", 9.0 + i as f64 / 100.0)
        });
    let called = |runs: [&str; 2]| {
        table("surface,run,ax\n", move |i, [x, ..]| format!("oak,{},{x}", runs[i / 150]))
    };
    let labels = &["--surface", "surface", "--trial", "run", "--rate", "100"];
    let rate = &["--rate", "100"];
    for (text, args, part) in [
        (called(["left_1", "right_1"]), &labels[..], "`left_1` and `right_1` end with one number"),
        (two_tables, &[], "line 2 begins rows of 3 columns"),
        (timed("Time (ticks)", |i| (16 * i).to_string()), &[], "has the unit `ticks`"),
        (
            timed("Unix Time (ms)", |i| format!("{:.2}", 1.7e9 + i as f64 / 100.0)),
            &[],
            "since 1970",
        ),
        (
            timed("time", |i| format!("{:.9}", 739_000.5 + i as f64 / 8_640_000.0)),
            &[],
            "--time-unit",
        ),
        (
            timed("time", |i| if i == 9 { "x".into() } else { i.to_string() }),
            &[],
            "`time` holds `x`",
        ),
        (
            table("ax\tay\n", |i, [x, ..]| {
                let thousands =
                    |n: usize| if n < 1000 { n.to_string() } else { format!("1,{:03}", n - 1000) };
                format!("{}\t{}", thousands(900 + i), x.len())
            }),
            rate,
            "may be 1.000 or 1000",
        ),
        (
            table("", |_, [x, y, _]| {
                let split = |x: String| x.trim_start_matches('-').replace('.', ",");
                [x, y].map(split).join(",")
            }),
            rate,
            "decimal marks or separate columns",
        ),
        (
            (0..3).map(|row| format!("{row}{}\n", ",1.5".repeat(299))).collect(),
            rate,
            "turn the table",
        ),
        (
            timed("time", |i| format!("{:.2}", 9.0 - i as f64 / 100.0)),
            rate,
            "newest row stands first",
        ),
        (
            table("channel,value\n", |i, [x, ..]| format!("{},{x}", i % 3)),
            rate,
            "column `channel` says of what a row holds the values (`0`, `1`, …)",
        ),
        (
            table("value,unit\n", |i, [x, ..]| format!("{x},{}", ["V", "mV"][i % 40 / 20])),
            rate,
            "column `unit` holds several units (V, mV)",
        ),
        (
            table("time,ax\n", |i, [x, ..]| format!("{},{x}", 10 * (i + i / 9 + i % 7 / 6))),
            &[],
            "misses",
        ),
    ] {
        let imported = import("oak/1.csv", text.as_bytes(), args);
        assert_ne!(imported.output.status.code(), Some(0), "{text:.60}: {}", imported.said());
        says(&imported.said(), &[part]);
    }
    // Read rightly, with a remark where something is left out.
    let frames = |imported: &Imported| -> Vec<usize> {
        let of = |entry: &surfaced::library::Entry| {
            entry.load().unwrap().signals.values().next().unwrap().frames()
        };
        imported.library().entries.iter().map(of).collect()
    };
    let lines = |text: &str, change: &dyn Fn(usize, &str) -> String| {
        text.lines().enumerate().map(|(at, line)| change(at, line) + "\n").collect::<String>()
    };
    let errors = lines(&plain, &|at, line| match at {
        100..103 => format!("#DIV/0!,{}", line.split_once(',').unwrap().1),
        _ => line.into(),
    });
    let errors = import("oak/1.csv", errors.as_bytes(), rate);
    assert_eq!(frames(&errors), [ROWS]);
    says(&errors.said(), &["filled in by straight lines: 3 values"]);
    let blank =
        lines(&plain, &|at, line| if (100..120).contains(&at) { ",,".into() } else { line.into() });
    assert_eq!(frames(&import("oak/1.csv", blank.as_bytes(), rate)), [99, 181]);
    assert_eq!(frames(&import("oak/1.csv", plain.repeat(2).as_bytes(), rate)), [ROWS, ROWS]);
    let nothing = plain.replacen("ax,ay,az\n", "ax,ay,az\nnan,nan,nan\nnan,nan,nan\n", 1);
    assert_eq!(import("oak/1.csv", nothing.as_bytes(), rate).series("a").frames(), ROWS);
    let units = timed("ms", |i| (10 * i).to_string()).replacen('\n', "\nms,LSB,LSB\n", 1);
    assert_eq!(import("oak/1.csv", units.as_bytes(), &[]).series("a").rate_hz(), 100.0);
    let heat = table("time,ax,T\n", |i, [x, y, _]| format!("{:.2},{x},{y}", i as f64 / 100.0));
    assert_eq!(import("oak/1.csv", heat.as_bytes(), &[]).series("t").frames(), ROWS);
    let thousands =
        table("ax;force\n", |i, [x, ..]| format!("{};1 {:03},5", x.replace('.', ","), i * 7 % 11));
    let thousands = import("oak/1.csv", thousands.as_bytes(), rate);
    assert_eq!(thousands.series("force").samples()[7], 1005.5);
    let over =
        table("ax,force\n", |i, [x, ..]| format!("{x},{}", if i < 20 { "2.5" } else { "OVER" }));
    let over = import("oak/1.csv", over.as_bytes(), rate);
    says(&over.said(), &["column `force` is left out", "`OVER`"]);
    let slow = timed("time_s", |i| format!("{:.2}", 0.08 * i as f64));
    let slow = import("oak/1.csv", slow.as_bytes(), &[]).series("a");
    assert_eq!((slow.rate_hz(), slow.samples()[2]), (12.5, value(1, 0) as f32));
    let seconds = timed("time (ms)", |i| format!("{:.2}", 0.01 * i as f64));
    let seconds = import("oak/1.csv", seconds.as_bytes(), &[]).said();
    says(&seconds, &["in units of ms, as its name says", "may be s: then say --time-unit 1"]);
    let zone = timed("time", |i| format!("2024-06-12 12:00:{:06.3}+02:00", i as f64 / 10.0));
    let zone = import("oak/1.csv", zone.as_bytes(), &[]);
    let about = About::read(zone.library().entries[0].places()[0]).unwrap();
    assert_eq!(about.started_at.as_deref(), Some("2024-06-12T10:00:00Z"));
    let quoted = table("surface,ax\n", |_, [x, ..]| format!("\"3\"\" pipe\",{x}"));
    let quoted = import("all.csv", quoted.as_bytes(), &["--surface", "surface", "--rate", "9"]);
    assert_eq!(quoted.library().entries[0].key.surface, "3\" pipe");
}

#[test]
fn rows_of_several_trials_are_told_apart() {
    let counted = |name: &str, count: fn(usize) -> String| {
        let text = table(&format!("{name},surface,ax\n"), move |i, [x, ..]| {
            format!("{},oak,{x}", count(i))
        });
        let imported =
            import("all.csv", text.as_bytes(), &["--surface", "surface", "--rate", "100"]);
        let signals = imported.library().entries[0].load().unwrap().signals;
        let sources: Vec<String> = signals.keys().map(|id| id.to_string()).collect();
        (imported.library().entries.len(), sources.join(", "))
    };
    let ax = || "ax".to_string();
    assert_eq!(counted("i", |i| (i % 100).to_string()), (3, ax()), "a counter that begins anew");
    assert_eq!(counted("Unnamed: 0", |i| (i % 75).to_string()), (4, ax()));
    assert_eq!(counted("nSeq", |i| (i % 16).to_string()), (1, ax()), "four bits");
    assert_eq!(counted("seq", |i| (i % 128).to_string()), (1, ax()), "seven bits");
    let stick_slip =
        |i: usize| format!("{:.3}", (i % 20) as f64 / 10.0 + (i * 7 % 3) as f64 / 90.0);
    let sawtooth = table("force,ax\n", |i, [x, ..]| format!("{},{x}", stick_slip(i)));
    let sawtooth = import("oak/1.csv", sawtooth.as_bytes(), &["--rate", "100"]);
    assert_eq!(sawtooth.series("force").frames(), ROWS, "a sensor may rise and fall so");
    let second = |i: usize| format!("{},{}", i / 100, i % 100 * 10);
    let parts = table("second,ms,ax\n", |i, [x, ..]| format!("{},{x}", second(i)));
    let parts = import("oak/1.csv", parts.as_bytes(), &["--rate", "100"]);
    assert_eq!(parts.library().entries.len(), 1, "{}", parts.said());
    assert_eq!(parts.series("ax").channels(), 1);
    // Rows of other trials between them; and trials side by side.
    let between = table("surface,ax\n", |i, [x, ..]| format!("{},{x}", ["oak", "felt"][i % 2]));
    let args = &["--surface", "surface", "--rate", "100"];
    says(&import("all.csv", between.as_bytes(), args).said(), &["sort the rows by trial"]);
    let beside = table("Force (N) Run #1,Force (N) Run #2\n", |_, [x, y, _]| format!("{x},{y}"));
    let beside = import("oak/1.csv", beside.as_bytes(), &["--rate", "100"]);
    says(&beside.said(), &["several runs side by side (Run #1, Run #2)"]);
    let wide: Vec<String> = (0..40).map(|column| format!("v{column}")).collect();
    let wide = table(&(wide.join(",") + "\n"), |_, [x, ..]| vec![x; 40].join(","));
    let wide = import("oak/1.csv", wide.as_bytes(), &["--rate", "100"]);
    says(&wide.said(), &["each row is read as one sample of 40 channels"]);
}

#[test]
fn a_sensor_that_ends_before_the_others_is_refused_with_what_it_may_mean() {
    let ends = |after: usize| {
        table("time,ax,mic\n", move |i, [x, y, _]| {
            let x = if i < after { x } else { String::new() };
            format!("{:.2},{x},{y}", i as f64 / 100.0)
        })
    };
    for (after, of_time) in [(75, true), (75, false), (200, true), (230, false)] {
        let args: &[&str] = if of_time { &[] } else { &["--rate", "100"] };
        let imported = import("oak/1.csv", ends(after).as_bytes(), args);
        let part = format!("`ax` (source `ax`) in its first {after} of 300 rows alone");
        says(&imported.said(), &[&part, "a table of its own"]);
    }
    let imported = import("oak/1.csv", ends(295).as_bytes(), &[]);
    assert_eq!(imported.series("mic").frames(), 295);
    let alone = import("oak/1.csv", ends(75).as_bytes(), &["--source", "mic=mic"]);
    assert_eq!(alone.series("mic").frames(), ROWS);
}

#[test]
fn files_of_one_import_have_the_same_units() {
    let (_dir, path) = temp();
    for (number, unit) in [(1, "g"), (2, "m/s^2")] {
        let above = format!("time,acc_x,acc_y\ns,{unit},{unit}\n");
        let text = table(&above, |i, [x, y, _]| format!("{:.2},{x},{y}", i as f64 / 100.0));
        write_file(&path.join(format!("in/oak/{number}.csv")), text.as_bytes());
    }
    let (from, out) = (path.join("in"), path.join("out"));
    let output = surfaced(&["import", "csv", text(&from), "--out", text(&out)]);
    assert_eq!(output.status.code(), Some(3));
    says(&said(&output), &["column `acc_x` has m/s^2, but g in the first table"]);
    assert_eq!(open(&out).unwrap().entries.len(), 1);
}

#[test]
fn trials_are_numbered_by_whole_numbers_however_they_are_written() {
    let text = |third: &str| {
        (0..60).fold("surface,run,t,ax\n".to_string(), |all, i| {
            let run = ["1.0", "2.0", third][i / 20];
            all + &format!("oak,{run},0.{:02},{}\n", i % 20, i * 7 % 11)
        })
    };
    let args = ["--surface", "surface", "--trial", "run"];
    let three = import("all.csv", text("3").as_bytes(), &args);
    let numbers: Vec<u32> = three.library().entries.iter().map(|entry| entry.key.number).collect();
    assert_eq!(numbers, [1, 2, 3]);
    let bad = import("all.csv", text("1.5").as_bytes(), &args);
    says(&bad.said(), &["line 42: the trial is `1.5`; expected a whole number"]);
}

#[test]
fn a_folder_of_a_person_is_not_taken_for_nothing() {
    let (_dir, path) = temp();
    for (at, person) in ["anna", "ben"].into_iter().enumerate() {
        for surface in ["oak", "slate"] {
            let file = format!("in/{person}/{surface}/{}.csv", at + 1);
            let text = table("ax\n", |_, [x, ..]| x);
            write_file(&path.join(file), text.as_bytes());
        }
    }
    let (from, out) = (path.join("in"), path.join("out"));
    let given = ["import", "csv", text(&from), "--out", text(&out), "--rate", "100"];
    let unsaid = surfaced(&given);
    assert_eq!(unsaid.status.code(), Some(2));
    says(
        &said(&unsaid),
        &["both `anna` and `ben` hold a folder `oak`", "{user}/{surface}/{trial}"],
    );
    assert!(!out.exists());
    let named = surfaced(&[&given[..], &["--names", "{user}/{surface}/{trial}"]].concat());
    assert!(named.status.success(), "{}", said(&named));
    let users: Vec<String> = open(&out).unwrap().entries.into_iter().map(|e| e.key.user).collect();
    assert_eq!(users, ["anna", "ben", "anna", "ben"]);
}

#[test]
fn lines_that_are_no_rows_are_left_out_and_said() {
    let rate = &["--rate", "100"][..];
    let plain = table("ax,ay,az\n", |_, cells| cells.join(","));
    let frames = |text: &str| {
        let imported = import("oak/1.csv", text.as_bytes(), rate);
        let entries = imported.library().entries;
        let of = |entry: &surfaced::library::Entry| entry.load().unwrap().signals["a"].frames();
        (entries.iter().map(of).collect::<Vec<_>>(), imported.said())
    };
    let (found, told) = frames(&(plain.clone() + "Done. 300 samples.\n"));
    assert_eq!(found, [ROWS], "{told}");
    says(&told, &["text, or cut off: 1 line; left out"]);
    assert_eq!(frames(&(plain.clone() + "0.125,0.2")).0, [ROWS], "its end was not written");
    let lines: Vec<&str> = plain.lines().collect();
    let between =
        lines[..151].join("\n") + "\n# trial 2\nButton pressed!\n" + &lines[151..].join("\n");
    assert_eq!(frames(&between).0, [150, 150], "another trial may begin there");
    // Four trials below each other, divided by empty lines, comments, or a clock that begins anew.
    let rows = &lines[1..];
    let divided = |between: &str| {
        let parts = rows.chunks(ROWS / 4).map(|part| part.join("\n")).collect::<Vec<_>>();
        frames(&format!("{}\n{}\n", lines[0], parts.join(between)))
    };
    for between in ["\n\n", "\n\n\n", "\n# next\n"] {
        let (found, told) = divided(between);
        assert_eq!(found, [ROWS / 4; 4], "{between:?}");
        says(&told, &["where another trial may begin: 1 trial"]);
    }
    let anew = table("time,ax,ay,az\n", |i, cells| {
        format!("{:.2},{}", 0.01 * (i % (ROWS / 4)) as f64, cells.join(","))
    });
    assert_eq!(frames(&anew).0, [ROWS / 4; 4]);
    let double = lines.join("\n\n");
    assert_eq!(frames(&double).0, [ROWS], "an empty line after each row divides nothing");
    let (_dir, path) = temp();
    let pauses = table("surface,ax\n", |i, [x, ..]| {
        format!("{},{x}", ["oak", "", "felt"][(i / 100).min(2)])
    });
    write_file(&path.join("anna_1.csv"), pauses.as_bytes());
    let out = path.join("out");
    let output = surfaced(
        &[
            &["import", "csv", text(&path.join("anna_1.csv")), "--out", text(&out)][..],
            &["--surface", "surface", "--names", "{user}_{trial}"],
            rate,
        ]
        .concat(),
    );
    says(&said(&output), &["without a label: 100 rows; left out"]);
    let entries = open(&out).unwrap().entries;
    let keys: Vec<String> = entries.iter().map(|entry| entry.key.to_string()).collect();
    assert_eq!(keys, ["felt · anna · trial 1", "oak · anna · trial 1"]);
}

#[test]
fn a_start_and_a_rate_above_the_rows_are_read_as_such() {
    let rows = table("1544027337.0, 1544027337.0\n32.0, 32.0\n", |_, [x, y, _]| format!("{x},{y}"));
    let imported = import("oak/1.csv", rows.as_bytes(), &[]);
    says(&imported.said(), &["the first two rows are when it began and its rate, 32 Hz"]);
    let trial = imported.library().entries[0].load().unwrap();
    let Signal::Series(series) = &trial.signals["sensor"] else { panic!("no series") };
    assert_eq!((series.frames(), series.channels(), series.rate_hz()), (ROWS, 2, 32.0));
    let imported = import("oak/1.csv", rows.as_bytes(), &["--rate", "64"]);
    says(&imported.said(), &["its second row says 32 Hz, but it would be read at 64 Hz"]);
    // Values that are times themselves go on.
    let times = table("", |i, _| format!("{}", 1_544_027_337.5 + i as f64));
    says(&import("oak/1.csv", times.as_bytes(), &[]).said(), &["error"]);
}

#[test]
fn clocks_and_counters_are_no_channels_and_axes_are() {
    let sources = |above: &str, row: fn(usize) -> String| {
        let rows = table(above, |i, cells| row(i) + &cells.join(","));
        let imported = import("oak/1.csv", rows.as_bytes(), &["--rate", "100"]);
        let trial = imported.library().entries[0].load().unwrap();
        let names = trial.signals.iter().map(|(id, signal)| match signal {
            Signal::Series(series) => format!("{id} {}", series.channels()),
            Signal::Image(_) => String::new(),
        });
        (names.collect::<Vec<_>>().join(", "), imported.said())
    };
    for (above, row) in [
        (
            "field.header.stamp,ax,ay,az\n",
            (|i| format!("{},", 1_700_000_000 + i)) as fn(usize) -> String,
        ),
        ("nSeq,ax,ay,az\n", |i| format!("{},", i % 16)),
        ("n,ax,ay,az\n", |i| format!("{},", i % 150)),
        ("x,ax,ay,az\n", |i| format!("{:.3},", 0.01 * i as f64 - 1.5)),
        ("part,ax,ay,az\n", |i| format!("{},", (i * 9_970 + i % 3 * 20) % 1_000_000)),
        ("dt_ms,ax,ay,az\n", |i| format!("{},", 10 + i * 7 % 3)),
        ("SampleTimeFine,ax,ay,az\n", |i| format!("{},", 16_667 * i + i % 3)),
        ("time (ms),ax,ay,az\n", |i| format!("{},", 10 * i)),
    ] {
        let (found, said) = sources(above, row);
        assert_eq!(found, "a 3", "{above}");
        let name = above.split(',').next().unwrap();
        says(&said, &[&format!("column `{name}`"), "is left out"]);
    }
    assert_eq!(sources("", |i| format!("{:.2},", 0.01 * i as f64)).0, "sensor 3");
    for above in ["x-axis (g),y-axis (g),z-axis (g)\n", "X_Value,Y_Value,Z_Value\n"] {
        assert_eq!(sources(above, |_| String::new()).0.matches('1').count(), 3, "{above}");
    }
    let fine = table("pressure\n", |i, _| format!("{}", 101_325.0 + 0.0001 * (i * 7 % 31) as f64));
    let fine = import("oak/1.csv", fine.as_bytes(), &["--rate", "100"]);
    says(&fine.said(), &["warning: column `pressure` has more digits than a sample holds"]);
}
