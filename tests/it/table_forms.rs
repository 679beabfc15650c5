//! Tables in the forms in which people's programs write them, each with the numbers that it holds: the
//! rate, the sources and their channels.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Output;

use crate::common::{open, says, temp, write_file};
use crate::plan::{said, surfaced, text};
use surfaced::library::{About, Library};
use surfaced::trial::{Series, Signal};

#[path = "../fuzz/files.rs"]
pub(crate) mod files;

const ROWS: usize = 300;

/// The value of a channel in a row, with three decimals.
fn value(row: usize, channel: usize) -> f64 {
    let wave = (0.37 * (row * (channel + 1)) as f64).sin() + channel as f64 / 10.0;
    (wave * 1000.0).round() / 1000.0
}

/// A table: its lines above the rows, and the cells of each row.
fn table(above: &str, row: impl Fn(usize, [String; 3]) -> String) -> String {
    let cells = |row: usize| [0, 1, 2].map(|channel| format!("{:.3}", value(row, channel)));
    let rows = (0..ROWS).map(|at| row(at, cells(at)) + "\n");
    format!("{above}{}", rows.collect::<String>())
}

/// A table with decimal commas and semicolons.
fn german(above: &str, row: impl Fn(usize, [String; 3]) -> String) -> String {
    table(above, |at, cells| row(at, cells.map(|cell| cell.replace('.', ","))))
}

fn comma(x: f64, digits: usize) -> String {
    format!("{x:.digits$}").replace('.', ",")
}

fn utf16(text: &str) -> Vec<u8> {
    [0xfeff].into_iter().chain(text.encode_utf16()).flat_map(u16::to_le_bytes).collect()
}

fn latin1(text: &str) -> Vec<u8> {
    text.chars().map(|c| u8::try_from(u32::from(c)).unwrap()).collect()
}

fn gz(text: &str) -> Vec<u8> {
    let mut packer = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packer.write_all(text.as_bytes()).unwrap();
    packer.finish().unwrap()
}

/// The result of the import of one file.
pub(crate) struct Imported {
    output: Output,
    out: PathBuf,
    _dir: tempfile::TempDir,
}

impl Imported {
    pub(crate) fn said(&self) -> String {
        said(&self.output) + &String::from_utf8_lossy(&self.output.stdout)
    }

    pub(crate) fn library(&self) -> Library {
        open(&self.out).unwrap_or_else(|error| panic!("{error}\n{}", self.said()))
    }

    fn series(&self, source: &str) -> Series {
        let trial = self.library().entries[0].load().unwrap();
        let Some(Signal::Series(series)) = trial.signals.get(source) else {
            panic!("no source `{source}`: {}", self.said())
        };
        series.clone()
    }
}

pub(crate) fn import(file: &str, bytes: &[u8], args: &[&str]) -> Imported {
    let (dir, path) = temp();
    let (file, out) = (path.join(file), dir.path().join("out"));
    write_file(&file, bytes);
    let all = [&["import", "csv", text(&file), "--out", text(&out)], args].concat();
    Imported { output: surfaced(&all), out, _dir: dir }
}

/// A form of a table: the file's name, its bytes, arguments, its rate, and the names of its sources with
/// the channels of [`value`] that they hold.
type Form<'a> = (&'a str, Vec<u8>, &'a [&'a str], f64, &'a [(&'a str, &'a [usize])]);

fn assert_read((file, bytes, args, rate_hz, sources): &Form<'_>) {
    let imported = import(&format!("oak/{file}"), bytes, args);
    let entries = imported.library().entries;
    assert_eq!(entries.len(), 1, "{file}: {}", imported.said());
    let found: Vec<&str> = entries[0].sources.iter().map(|id| id.as_str()).collect();
    let expected: Vec<&str> = sources.iter().map(|(source, _)| *source).collect();
    assert_eq!(found, expected, "{file}: {}", imported.said());
    for (source, channels) in *sources {
        let series = imported.series(source);
        assert_eq!((series.rate_hz(), series.channels()), (*rate_hz, channels.len()), "{file}");
        assert_eq!(series.frames(), ROWS, "{file}: {}", imported.said());
        for (row, frame) in series.samples().chunks(channels.len()).enumerate() {
            let right: Vec<f32> = channels.iter().map(|at| value(row, *at) as f32).collect();
            assert_eq!(frame, right, "{file}, row {row}");
        }
    }
}

#[test]
fn tables_of_phones_loggers_and_programs_hold_their_numbers() {
    let a3: &[(&str, &[usize])] = &[("a", &[0, 1, 2])];
    let acc3: &[(&str, &[usize])] = &[("acc", &[0, 1, 2])];
    let s3: &[(&str, &[usize])] = &[("sensor", &[0, 1, 2])];
    let phyphox = "\"Time (s)\",\"Linear Acceleration x (m/s^2)\",\"Linear Acceleration y (m/s^2)\",\
                   \"Linear Acceleration z (m/s^2)\"\n";
    let lvm = "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n\
               Multi_Headings\tNo\nX_Columns\tOne\nDate\t2020/01/01\nTime\t12:00:00.0\n\
               ***End_of_Header***\t\n\t\nChannels\t3\t\t\t\nSamples\t300\t300\t300\t\n\
               Y_Unit_Label\tVolts\tVolts\tVolts\t\nX0\t0.0000E+0\t0.0000E+0\t0.0000E+0\t\n\
               Delta_X\t0.001000\t0.001000\t0.001000\t\n***End_of_Header***\t\t\t\t\n\
               X_Value\tVoltage_0\tVoltage_1\tVoltage_2\tComment\n";
    let ni = "Sample Rate;1000\nDevice;Dev1\n\nTime;Dev1/ai0;Dev1/ai1;Dev1/ai2\n";
    let forms: &[Form<'_>] = &[
        (
            "phyphox_1.csv",
            table(phyphox, |i, [x, y, z]| format!("{:.9E},{x}E0,{y}E0,{z}E0", i as f64 * 5e-3))
                .into(),
            &[],
            200.0,
            &[("linearacceleration", &[0, 1, 2])],
        ),
        (
            "physics_toolbox_1.csv",
            german("time;gFx;gFy;gFz;\n", |i, [x, y, z]| {
                format!("12:00:{};{x};{y};{z};", comma(i as f64 / 100.0, 3).replace(',', "."))
            })
            .into(),
            &[],
            100.0,
            &[("gf", &[0, 1, 2])],
        ),
        (
            "sensor_logger_1.csv",
            table("time,seconds_elapsed,z,y,x\n", |i, [x, y, z]| {
                let ns = 1_700_000_000_123_456_789_u64 + i as u64 * 10_000_000;
                format!("{ns},{:.9},{x},{y},{z}", 0.25 + i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            s3,
        ),
        (
            "labview_1.lvm",
            table(lvm, |i, [x, y, z]| format!("{:.6}\t{x}\t{y}\t{z}\t", i as f64 / 1000.0)).into(),
            &[],
            1000.0,
            &[("voltage", &[0, 1, 2])],
        ),
        (
            "ni_1.csv",
            german(ni, |i, [x, y, z]| {
                format!("01.02.2024 12:00:{};{x};{y};{z}", comma(i as f64 / 1000.0, 3))
            })
            .into(),
            &[],
            1000.0,
            &[("dev1ai", &[0, 1, 2])],
        ),
        (
            "vernier_1.csv",
            table("\"Run 1: Time (s)\",\"Run 1: Force (N)\"\n", |i, [x, ..]| {
                format!("{:.2},{x}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            &[("force", &[0])],
        ),
        (
            "serial_monitor_1.txt",
            table("", |i, [x, y, z]| {
                let ms = 86_399_000 + 10 * i;
                let (s, ms) = (ms / 1000 % 86_400, ms % 1000);
                format!("{:02}:{:02}:{:02}.{ms:03} -> {x},{y},{z}", s / 3600, s / 60 % 60, s % 60)
            })
            .into(),
            &[],
            100.0,
            s3,
        ),
        (
            "pandas_1.csv",
            table(",time,acc_x,acc_y,acc_z\n", |i, [x, y, z]| {
                format!("{i},{},{x},{y},{z}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            acc3,
        ),
        (
            "pandas_without_names_1.csv",
            table(",0,1,2\n", |i, [x, y, z]| format!("{i},{x},{y},{z}")).into(),
            &["--rate", "100"],
            100.0,
            s3,
        ),
        (
            "pandas_two_levels_1.csv",
            table(",acc,acc,gyro\n,x,y,x\ntime,,,\n", |i, [x, y, z]| {
                format!("{:.2},{x},{y},{z}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            &[("acc", &[0, 1]), ("gyro", &[2])],
        ),
        (
            "excel_german_1.csv",
            latin1(&german(
                "Zeit [ms];acc_x (m/s²);acc_y (m/s²);acc_z (m/s²)\r\n",
                |i, [x, y, z]| format!("{};{x};{y};{z}\r", 5 * i),
            )),
            &[],
            200.0,
            acc3,
        ),
        (
            "excel_days_1.csv",
            german("Zeit;acc_x;acc_y;acc_z\n", |i, [x, y, z]| {
                format!("{};{x};{y};{z}", comma(45000.5 + i as f64 / 8_640_000.0, 10))
            })
            .into(),
            &[],
            100.0,
            acc3,
        ),
        (
            "excel_heads_1.csv",
            german(";acc;;\nt;x;y;z\ns;g;g;g\n", |i, [x, y, z]| {
                format!("{};{x};{y};{z}", comma(i as f64 / 100.0, 2))
            })
            .into(),
            &[],
            100.0,
            acc3,
        ),
        (
            "matlab_1.csv",
            table("t,ax,ay,az\n", |i, [x, y, z]| format!("{},{x},{y},{z}", i as f64 / 1000.0))
                .into(),
            &[],
            1000.0,
            a3,
        ),
        (
            "quoted_1.csv",
            german("\"t\",\"ax\",\"ay\",\"az\"\n", |i, [x, y, z]| {
                format!("\"{}\",\"{x}\",\"{y}\",\"{z}\"", comma(i as f64 / 100.0, 2))
            })
            .into(),
            &[],
            100.0,
            a3,
        ),
        (
            "utf16_1.csv",
            utf16(&german("Zeit\tax\tay\taz\r\n", |i, [x, y, z]| {
                format!("{}\t{x}\t{y}\t{z}\r", comma(i as f64 / 100.0, 2))
            })),
            &[],
            100.0,
            a3,
        ),
        (
            "bom_1.csv",
            table("\u{feff}timestamp (us),ax,ay,az\n", |i, [x, y, z]| {
                format!("{},{x},{y},{z}", 5000 * i)
            })
            .into(),
            &[],
            200.0,
            a3,
        ),
        (
            "packed_1.csv.gz",
            gz(&table("t,ax,ay,az\n", |i, [x, y, z]| format!("{},{x},{y},{z}", i as f64 / 100.0))),
            &[],
            100.0,
            a3,
        ),
        (
            "savetxt_1.txt",
            table("# t ax ay az\n", |i, [x, y, z]| {
                format!("{:.18e} {x} {y} {z}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            a3,
        ),
        (
            "r_1.txt",
            table("\"t\" \"ax\" \"ay\" \"az\"\n", |i, [x, y, z]| {
                format!("\"{}\" {:.2} {x} {y} {z}", i + 1, i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            a3,
        ),
        (
            "comments_1.csv",
            table("# device 5\nt,ax,ay,az\n", |i, [x, y, z]| {
                let pause = if i == 50 { "# pause\n\n" } else { "" };
                format!("{pause}{:.2},{x},{y},{z}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            a3,
        ),
        (
            "units_1.csv",
            table("time,ax,ay,az\nms,g,g,g\n", |i, [x, y, z]| format!("{i},{x},{y},{z}")).into(),
            &[],
            1000.0,
            a3,
        ),
        (
            "one_name_1.csv",
            table("time,acc,acc,acc\n", |i, [x, y, z]| {
                format!("{:.2},{x},{y},{z}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            acc3,
        ),
        (
            "millis_1.csv",
            table("millis,ax,ay,az\n", |i, [x, y, z]| format!("{},{x},{y},{z}", 73_210 + 10 * i))
                .into(),
            &[],
            100.0,
            a3,
        ),
        (
            "micros_that_wrap_1.csv",
            table("micros,ax,ay,az\n", |i, [x, y, z]| {
                format!("{},{x},{y},{z}", (4_294_000_000_u64 + 10_000 * i as u64) % (1 << 32))
            })
            .into(),
            &[],
            100.0,
            a3,
        ),
        (
            "iso_1.csv",
            table("when,ax,ay,az\n", |i, [x, y, z]| {
                let ms = 59_000 + i * 5 / 2;
                format!(
                    "2024-01-31T12:{:02}:{:02}.{:03}Z,{x},{y},{z}",
                    ms / 60_000,
                    ms / 1000 % 60,
                    ms % 1000
                )
            })
            .into(),
            &[],
            400.0,
            a3,
        ),
        (
            "plain_1.csv",
            table("", |_, [x, y, z]| format!("{x},{y},{z},")).into(),
            &["--rate", "250"],
            250.0,
            s3,
        ),
        (
            "labelled_1.csv",
            table("t,ax,ay,az,class\n", |i, [x, y, z]| {
                format!("{},{x},{y},{z},{}", i as f64 / 100.0, i / 100)
            })
            .into(),
            &[],
            100.0,
            a3,
        ),
    ];
    for form in forms {
        let names: &[&str] = &["--names", "{surface}/*_{trial}"];
        let (file, bytes, args, rate_hz, sources) = form;
        let args = [*args, names].concat();
        assert_read(&(file, bytes.clone(), &args, *rate_hz, sources));
    }
}

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
            "t,x\n".to_string() + &t(|i| format!("0.{i:02},1\n")) + "end\n",
            &[],
            &["line 52 has 1 column"],
        ),
        (
            "t,x\n".to_string() + &t(|i| format!("{}.0{},{i}\n", i / 10, i % 10)),
            &[],
            &["times", "time"],
        ),
        ("PK\u{3}\u{4}".to_string(), &["--rate", "9"], &["Excel workbook"]),
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
        table("ax;force\n", |i, [x, ..]| format!("{};1 {:03},5", x.replace('.', ","), i));
    let thousands = import("oak/1.csv", thousands.as_bytes(), rate);
    assert_eq!(thousands.series("force").samples()[7], 1007.5);
    let over =
        table("ax,force\n", |i, [x, ..]| format!("{x},{}", if i < 20 { "2.5" } else { "OVER" }));
    let over = import("oak/1.csv", over.as_bytes(), rate);
    says(&over.said(), &["column `force` is left out", "`OVER`"]);
    let slow = timed("time_s", |i| format!("{:.2}", 0.08 * i as f64));
    let slow = import("oak/1.csv", slow.as_bytes(), &[]).series("a");
    assert_eq!((slow.rate_hz(), slow.samples()[2]), (12.5, value(1, 0) as f32));
    let zone = timed("time", |i| format!("2024-06-12 12:00:{:06.3}+02:00", i as f64 / 10.0));
    let zone = import("oak/1.csv", zone.as_bytes(), &[]);
    let about = About::read(zone.library().entries[0].places()[0]).unwrap();
    assert_eq!(about.started_at.as_deref(), Some("2024-06-12T10:00:00Z"));
    let quoted = table("surface,ax\n", |_, [x, ..]| format!("\"3\"\" pipe\",{x}"));
    let quoted = import("all.csv", quoted.as_bytes(), &["--surface", "surface", "--rate", "9"]);
    assert_eq!(quoted.library().entries[0].key.surface, "3\" pipe");
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

fn npy(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
    [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header.as_bytes(), data]
        .concat()
}

/// A ZIP file of stored or deflated members, as NumPy writes it.
fn npz(members: &[(&str, Vec<u8>)], deflate: bool) -> Vec<u8> {
    let (mut all, mut directory) = (Vec::new(), Vec::new());
    for (name, content) in members {
        let mut packer =
            flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::fast());
        packer.write_all(content).unwrap();
        let packed = if deflate { packer.finish().unwrap() } else { content.clone() };
        let fields = [
            [20, 0, if deflate { 8 } else { 0 }, 0, 0].map(u16::to_le_bytes).concat(),
            [0, packed.len() as u32, content.len() as u32].map(u32::to_le_bytes).concat(),
            [name.len() as u16, 0].map(u16::to_le_bytes).concat(),
        ]
        .concat();
        let offset = all.len() as u32;
        directory.extend(
            [b"PK\x01\x02\x14\x00", &fields[..], &[0; 10], &offset.to_le_bytes(), name.as_bytes()]
                .concat(),
        );
        all.extend([b"PK\x03\x04", &fields[..], name.as_bytes(), &packed].concat());
    }
    let (start, size, count) = (all.len() as u32, directory.len() as u32, members.len() as u16);
    all.extend(directory);
    all.extend(
        [b"PK\x05\x06\0\0\0\0", &[count, count].map(u16::to_le_bytes).concat()[..]].concat(),
    );
    all.extend([size, start].map(u32::to_le_bytes).concat());
    all.extend([0, 0]);
    all
}

#[test]
fn arrays_of_numpy_are_trials() {
    // Three trials of two channels of 40 samples.
    let at = |trial: usize, channel: usize, row: usize| (trial * 1000 + channel * 100 + row) as i16;
    let numbers: Vec<i16> =
        (0..3).flat_map(|t| (0..2).flat_map(move |c| (0..40).map(move |r| at(t, c, r)))).collect();
    let small = numbers.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let large = numbers.iter().flat_map(|x| f64::from(*x).to_be_bytes()).collect::<Vec<u8>>();
    let words = ["oak", "ash", "oak"].map(|word| {
        (0..4)
            .flat_map(|at| word.chars().nth(at).map_or(0, u32::from).to_le_bytes())
            .collect::<Vec<u8>>()
    });
    let labels = npy("<U4", "(3,)", &words.concat());
    let array = npy("<i2", "(3, 2, 40)", &small);
    let file = |deflate| npz(&[("X.npy", array.clone()), ("y.npy", labels.clone())], deflate);
    for (name, bytes, args, keys) in [
        ("oak/1.npy", array.clone(), &[][..], ["oak 1", "oak 2", "oak 3"]),
        ("oak/1.npy", npy(">f8", "(3, 2, 40)", &large), &[], ["oak 1", "oak 2", "oak 3"]),
        ("all.npz", file(false), &["--labels", "y"], ["ash 1", "oak 1", "oak 2"]),
        ("all.npz", file(true), &["--labels", "y", "--variable", "X"], ["ash 1", "oak 1", "oak 2"]),
    ] {
        let imported = import(name, &bytes, &[&["--rate", "100"], args].concat());
        let entries = imported.library().entries;
        let found: Vec<String> =
            entries.iter().map(|e| format!("{} {}", e.key.surface, e.key.number)).collect();
        assert_eq!(found, keys, "{}", imported.said());
        let trial = entries[2].load().unwrap();
        let Signal::Series(series) = &trial.signals["sensor"] else { panic!("no series") };
        let right = (0..40).flat_map(|row| [0, 1].map(|channel| f32::from(at(2, channel, row))));
        assert_eq!(series.samples(), right.collect::<Vec<_>>(), "{name}");
    }
    for (bytes, args, part) in [
        (array.clone(), &[][..], "--rate HZ"),
        (
            npy("<i2", "(3, 40, 2)", &small),
            &["--rate", "9"],
            "expected trials × channels × samples",
        ),
        (npy("<i2", "(9000, 2, 40)", &small), &["--rate", "9"], "truncated"),
        (npy("|O", "(3,)", &small), &["--rate", "9"], "its elements are"),
        (array[..20].to_vec(), &["--rate", "9"], "cut short"),
    ] {
        says(&import("oak/1.npy", &bytes, args).said(), &[part]);
    }
    let few = import("oak/1.npz", &file(true), &["--rate", "9", "--labels", "X"]);
    says(&few.said(), &["labels have the shape"]);
}

proptest::proptest! {
    #[test]
    fn no_damaged_file_breaks_the_readers(
        kind in 0..files::KINDS.len() as u8,
        at in proptest::prelude::any::<proptest::sample::Index>(),
        with in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..6),
        end in proptest::prelude::any::<proptest::sample::Index>(),
    ) {
        let mut bytes = match files::KINDS[kind as usize] {
            "npy" => npy("<f4", "(2, 2, 10)", &[1; 160]),
            "mat" => crate::mat_forms::sample(),
            "npz" => npz(&[("X.npy", npy("<f4", "(2, 2, 10)", &[1; 160]))], true),
            "wav" => {
                let spec = hound::WavSpec {
                    channels: 2,
                    sample_rate: 1000,
                    bits_per_sample: 16,
                    sample_format: hound::SampleFormat::Int,
                };
                let mut bytes = std::io::Cursor::new(Vec::new());
                let mut writer = hound::WavWriter::new(&mut bytes, spec).unwrap();
                (0..20).for_each(|x| writer.write_sample(x).unwrap());
                writer.finalize().unwrap();
                bytes.into_inner()
            }
            sound @ ("mp3" | "m4a" | "ogg") => {
                let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lossy");
                std::fs::read(folder.join(format!("tone.{sound}"))).unwrap()
            }
            _ => "# a\n\"t (s)\";x\n0,1;2\n0,2;4\n0,3;nan\n0,4;5\n".into(),
        };
        let start = at.index(bytes.len());
        bytes.splice(start..(start + with.len()).min(bytes.len()), with);
        bytes.truncate(1 + end.index(bytes.len()));
        files::read(&[&[kind], &bytes[..]].concat());
    }
}

/// The trials that an import of two long tables makes: surface, number and session; and what it said.
fn sessions(args: &[&str], of_runs: [[u32; 2]; 2]) -> (Vec<(u32, Option<String>)>, String) {
    let (dir, _) = temp();
    for (name, runs) in ["monday_1", "tuesday_1"].into_iter().zip(of_runs) {
        let row = |at: usize, [x, ..]: [String; 3]| {
            let (run, day) = (runs[usize::from(at >= ROWS / 2)], at / (ROWS / 2));
            format!("oak,{run},day {day},{x}")
        };
        let text = table("material,run,day,f\n", row);
        write_file(&dir.path().join(format!("in/{name}.csv")), text.as_bytes());
    }
    let (input, out) = (dir.path().join("in"), dir.path().join("out"));
    let given = ["import", "csv", text(&input), "--out", text(&out), "--rate", "100"];
    let labels = ["--surface", "material", "--trial", "run", "--source", "force=f"];
    let output = surfaced(&[&given[..], &labels, args].concat());
    assert!(output.status.success(), "{}", said(&output));
    let key = |entry: surfaced::library::Entry| (entry.key.number, entry.key.session);
    (open(&out).unwrap().entries.into_iter().map(key).collect(), said(&output))
}

#[test]
fn an_import_names_sessions_by_a_column_a_pattern_or_the_file_and_proposes_the_file() {
    let apart = [[1, 2], [3, 4]];
    let named = |args: &[&str]| {
        let (trials, said) = sessions(args, apart);
        assert!(!said.contains("--session file"), "{said}");
        let names = trials.into_iter().map(|(_, session)| session.unwrap_or_default());
        names.collect::<Vec<_>>().join(", ")
    };
    assert_eq!(named(&["--session", "day"]), "day 0, day 1, day 0, day 1");
    assert_eq!(named(&["--session", "{session}_*"]), "monday, monday, tuesday, tuesday");
    assert_eq!(named(&["--session", "file"]), "monday_1, monday_1, tuesday_1, tuesday_1");
    assert_eq!(named(&["--session", "none"]), ", , , ");
    let (trials, said) = sessions(&[], apart);
    assert!(trials.iter().all(|(_, session)| session.is_none()));
    assert!(said.contains("2 of 2 tables hold several trials") && said.contains("--session file"));
}

#[test]
fn sessions_that_each_count_their_trials_from_1_lose_none() {
    let (trials, _) = sessions(&["--session", "file"], [[1, 2], [1, 2]]);
    let of = |number: u32, session: &str| (number, Some(session.to_string()));
    let expected = [of(1, "monday_1"), of(2, "monday_1"), of(3, "tuesday_1"), of(4, "tuesday_1")];
    assert_eq!(trials, expected);
}
