//! Tables in the forms in which people's programs write them, each with the numbers that it holds: the
//! rate, the sources and their channels.

use std::io::Write;
use std::path::PathBuf;
use std::process::Output;

use crate::common::{open, temp, write_file};
use crate::plan::{said, surfaced, text};
use surfaced::library::Library;
use surfaced::trial::{Series, Signal};

#[path = "../fuzz/files.rs"]
pub(crate) mod files;

pub(crate) const ROWS: usize = 300;

/// The value of a channel in a row, with three decimals.
pub(crate) fn value(row: usize, channel: usize) -> f64 {
    let wave = (0.37 * (row * (channel + 1)) as f64).sin() + channel as f64 / 10.0;
    (wave * 1000.0).round() / 1000.0
}

/// A table: its lines above the rows, and the cells of each row.
pub(crate) fn table(above: &str, row: impl Fn(usize, [String; 3]) -> String) -> String {
    let cells = |row: usize| [0, 1, 2].map(|channel| format!("{:.3}", value(row, channel)));
    let rows = (0..ROWS).map(|at| row(at, cells(at)) + "\n");
    format!("{above}{}", rows.collect::<String>())
}

/// A table with decimal commas and semicolons.
pub(crate) fn german(above: &str, row: impl Fn(usize, [String; 3]) -> String) -> String {
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
    pub(crate) output: Output,
    pub(crate) out: PathBuf,
    _dir: tempfile::TempDir,
}

impl Imported {
    pub(crate) fn said(&self) -> String {
        said(&self.output) + &String::from_utf8_lossy(&self.output.stdout)
    }

    pub(crate) fn library(&self) -> Library {
        open(&self.out).unwrap_or_else(|error| panic!("{error}\n{}", self.said()))
    }

    pub(crate) fn series(&self, source: &str) -> Series {
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
            "rigol_1.csv",
            table(
                "X,CH1,CH2,CH3,Start,Increment,\nSequence,V,V,V,-1.5E-01,5E-03\n",
                |i, [x, y, z]| format!("{i},{x},{y},{z},"),
            )
            .into(),
            &["--source", "ch=CH1,CH2,CH3"],
            200.0,
            &[("ch", &[0, 1, 2])],
        ),
        (
            "lvm_without_x_1.lvm",
            table(&lvm.replace("X_Columns\tOne", "X_Columns\tNo"), |_, [x, y, z]| {
                format!("\t{x}\t{y}\t{z}\t")
            })
            .into(),
            &["--rate", "1000"],
            1000.0,
            &[("voltage", &[0, 1, 2])],
        ),
        (
            "teraterm_1.log",
            table("", |i, [x, y, z]| {
                format!("[Tue Mar 05 14:03:{:06.3} 2024] {x},{y},{z}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            s3,
        ),
        (
            "logging_1.log",
            german("", |i, [x, y, z]| {
                let time = format!("{:06.3}", i as f64 / 100.0).replace('.', ",");
                format!("2024-03-05 14:03:{time} - INFO - {x};{y};{z}")
            })
            .into(),
            &["--rate", "100"],
            100.0,
            s3,
        ),
        (
            "begun_in_the_middle_1.log",
            table("=~=~= PuTTY log =~=~=\n5,0.5\n", |_, [x, y, z]| format!("{x},{y},{z}")).into(),
            &["--rate", "100"],
            100.0,
            s3,
        ),
        (
            "timedelta_1.csv",
            table(",ax,ay,az\n", |i, [x, y, z]| {
                format!("0 days 00:00:{:09.6},{x},{y},{z}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            a3,
        ),
        (
            "pandas_by_date_1.csv",
            table("time,0,1,2\n", |i, [x, y, z]| {
                format!("2024-03-05 14:03:{:09.6},{x},{y},{z}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            s3,
        ),
        (
            "dashes_1.csv",
            table("time fx fy fz gap\n", |i, [x, y, z]| {
                format!("14:03:{:06.3} {x} {y} {z} -", i as f64 / 100.0)
            })
            .into(),
            &["--source", "f=fx,fy,fz"],
            100.0,
            &[("f", &[0, 1, 2])],
        ),
        (
            "plotter_1.txt",
            table("", |_, [x, y, z]| format!("ax:{x}, ay: {y}, az:{z}")).into(),
            &["--rate", "100"],
            100.0,
            a3,
        ),
        (
            "plotter_arrows_1.txt",
            table("", |i, [x, y, z]| {
                format!("14:03:{:06.3} -> ax:{x}\tay:{y}\taz:{z}", i as f64 / 100.0)
            })
            .into(),
            &[],
            100.0,
            a3,
        ),
        (
            "minus_1.csv",
            table("ax,ay,az\n", |_, [x, y, z]| format!("{},{y}D0,{z}", x.replace('-', "\u{2212}")))
                .into(),
            &["--rate", "100"],
            100.0,
            a3,
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
