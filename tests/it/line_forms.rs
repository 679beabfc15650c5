//! The forms in which people print numbers, each read to the right numbers.

#[path = "../fuzz/printed_lines.rs"]
mod printed_lines;

use proptest::prelude::*;
use surfaced::device::lines::{Column, LinesEvent, LinesIntake, LinesStream, Survey};
use surfaced::scene::SourceId;

/// Rows of a form at 100 Hz.
const ROWS: usize = 400;

/// Three numbers that go up and down, with two decimals.
fn numbers(i: usize) -> [f64; 3] {
    [0.7, 1.9, 4.3].map(|step| ((i as f64 * step).sin() * 981.0).round() / 100.0)
}

fn survey(text: &[String]) -> Survey {
    let mut survey = Survey::new(false, None);
    for (i, line) in text.iter().enumerate() {
        survey.feed(format!("{line}\n").as_bytes(), i as f64 * 0.01);
    }
    survey
}

/// The frames that lines become, NaN where they are missing, and the reason why none come.
fn frames(columns: Vec<Column>, text: &[String]) -> (Vec<Vec<f32>>, Option<String>) {
    let width = columns.len();
    let id = SourceId::new("sensor").unwrap();
    let stream = LinesStream { id, columns, scale: Some(1.0) };
    let mut intake = LinesIntake::new(vec![stream], None, 100.0);
    let mut frames = Vec::new();
    for (i, line) in text.iter().enumerate() {
        intake.feed(format!("{line}\n").as_bytes(), i as f64 * 0.01, |event| match event {
            LinesEvent::Frames { samples, .. } => {
                frames.extend(samples.chunks(width).map(<[f32]>::to_vec));
            }
            LinesEvent::Missing(count) => {
                frames.extend(vec![vec![f32::NAN; width]; count as usize]);
            }
        });
    }
    (frames, intake.refused)
}

/// The channels that a survey finds, and the frames that follow from them.
fn learnt(text: &[String]) -> Vec<Vec<f32>> {
    let survey = survey(text);
    assert_eq!(survey.problem(), None);
    frames(survey.measuring(), text).0
}

type Print = fn(usize, [String; 3]) -> String;

fn comma(text: &str) -> String {
    text.replace('.', ",")
}

/// How a program prints a row, given its number and three numbers as text.
const FORMS: &[(&str, Print)] = &[
    ("plain", |_, [x, y, z]| format!("{x},{y},{z}")),
    ("carriage return, byte order mark", |i, [x, y, z]| {
        format!("{}{x},{y},{z}\r", if i == 0 { "\u{feff}" } else { "" })
    }),
    ("tuple", |_, [x, y, z]| format!("({x}, {y}, {z})")),
    ("list", |_, [x, y, z]| format!("[{x}, {y}, {z}]")),
    ("np.array", |_, [x, y, z]| format!("[ {x:>6}  {y:>6}  {z:>6}]")),
    ("repr of an array", |_, [x, y, z]| format!("array([{x}, {y}, {z}], dtype=float32)")),
    ("list of np.float64", |_, [x, y, z]| {
        format!("[np.float64({x}), np.float64({y}), np.float64({z})]")
    }),
    ("bytes of Python", |_, [x, y, z]| format!("b'{x},{y},{z}\\r\\n'")),
    ("comment", |_, [x, y, z]| format!("/*{x},{y},{z}*/")),
    ("comment with blanks", |_, [x, y, z]| format!("/* {x}, {y}, {z} */")),
    ("dollar and semicolon", |_, [x, y, z]| format!("${x} {y} {z};")),
    ("braces", |_, [x, y, z]| format!("{{{x};{y};{z}}}")),
    ("quotes", |_, [x, y, z]| format!("\"{x}\",\"{y}\",\"{z}\"")),
    ("tabs and blanks", |_, [x, y, z]| format!("{x}\t {y}\t\t{z} \t")),
    ("trailing comma", |_, [x, y, z]| format!("{x}, {y}, {z},")),
    ("bars", |_, [x, y, z]| format!("| {x} | {y} | {z} |")),
    ("plus signs", |_, [x, y, z]| format!("{:+.2};{:+.2};{:+.2}", f(&x), f(&y), f(&z))),
    ("signs apart", |_, all| all.map(|x| x.replace('-', "-   ")).join(",")),
    ("a balance", |_, all| {
        let sign = |x: String| match x.strip_prefix('-') {
            Some(x) => format!("-{x:>9}"),
            None => format!("+{x:>9}"),
        };
        let [x, y, z] = all.map(sign);
        format!("N     {x} g,ST,GS,{y}kg,{z}")
    }),
    ("signs after names", |_, all| {
        let [x, y, z] = all.map(|x| x.replace('-', "- "));
        format!("X = {x} Y = {y} Z = {z}")
    }),
    ("log with dashes", |i, [x, y, z]| {
        format!("2024-03-01 10:00:{:02} - root - INFO - {x} {y} {z}", i / 100)
    }),
    ("rules between rows", |i, [x, y, z]| {
        format!("{}\n{x},{y},{z}", ["=====", "-----", "--", "},", "}", "]", "|"][i % 7])
    }),
    ("object in lines", |_, [x, y, z]| {
        format!("{{\n  \"x\": {x},\n  \"y\": {y},\n  \"z\": {z}\n}},")
    }),
    ("Zephyr", |i, [x, y, z]| {
        format!("[00:00:{:02}.{:03},037] <inf> imu: {x} {y} {z}", i / 100, 10 * (i % 100))
    }),
    ("log with semicolons", |i, [x, y, z]| {
        format!("2024-03-01 10:00:{:02},{:03};{x};{y};{z}", i / 100, 10 * (i % 100))
    }),
    ("exponents", |_, [x, y, z]| format!("{:+.3e} {:.3E} {:e}", f(&x), f(&y), f(&z))),
    ("decimal commas", |_, [x, y, z]| comma(&format!("{x};{y};{z}"))),
    ("decimal commas and tabs", |_, [x, y, z]| comma(&format!("{x}\t{y}\t{z}"))),
    ("decimal commas and blanks", |_, [x, y, z]| comma(&format!("{x} {y} {z}"))),
    ("decimal commas in quotes", |_, [x, y, z]| {
        format!("\"{}\",\"{}\",\"{}\"", comma(&x), comma(&y), comma(&z))
    }),
    ("Arduino's plotter", |_, [x, y, z]| format!("x:{x},y:{y},z:{z}")),
    ("labels and blanks", |_, [x, y, z]| format!("x: {x} y: {y} z: {z}")),
    ("labels and tabs", |_, [x, y, z]| format!("x:\t{x}\ty:\t{y}\tz:\t{z}")),
    ("equals signs", |_, [x, y, z]| format!("x={x} y={y} z={z}")),
    ("any order", |i, [x, y, z]| match i % 3 {
        0 => format!("x:{x} y:{y} z:{z}"),
        1 => format!("z:{z} x:{x} y:{y}"),
        _ => format!("y:{y} z:{z} x:{x}"),
    }),
    ("names of several words", |_, [x, y, z]| format!("Acceleration X: {x}, Y: {y}, Z: {z} m/s^2")),
    ("names without colons", |_, [x, y, z]| format!("X {x} Y {y} Z {z}")),
    ("one unit at the end", |_, [x, y, z]| format!("X: {x} Y: {y} Z: {z} m/s^2")),
    ("units behind a blank", |_, [x, y, z]| format!("X: {x} g Y: {y} g Z: {z} g")),
    ("units stuck", |_, [x, y, z]| format!("{x}g,{y}g,{z}g")),
    ("percent, degrees", |_, [x, y, z]| format!("{x}% {y}°C {z} °C")),
    ("m/s²", |_, [x, y, z]| format!("{x}m/s²\t{y}m/s^2\t{z}m/s2")),
    ("numeric names", |_, [x, y, z]| format!("0:{x} 1:{y} 2:{z}")),
    ("teleplot", |_, [x, y, z]| format!(">x:{x}\n>y:{y}\n>z:{z}|g")),
    ("teleplot with units", |_, [x, y, z]| format!(">x:{x}§m/s²|g\n>y:{y}§m/s²|g\n>z:{z}§g")),
    ("teleplot with timestamps", |i, [x, y, z]| {
        let t = 1_700_000_000_000_u64 + i as u64 * 10;
        format!("x:{t}:{x}|g\ny:{t}:{y}|g\nz:{t}:{z}|g")
    }),
    ("one name a line", |_, [x, y, z]| format!("x={x}\ny={y}\nz={z}")),
    ("two lines a row", |_, [x, y, z]| format!("acc: {x} {y}\ngyro: {z}")),
    ("object", |_, [x, y, z]| format!("{{\"x\":{x},\"y\":{y},\"z\":{z}}}")),
    ("object of Python", |_, [x, y, z]| format!("{{'x': {x}, 'y': {y}, 'z': {z}}}")),
    ("object with a text", |i, [x, y, z]| {
        let state = if i % 5 == 0 { "rest" } else { "drag" };
        format!("{{\"state\":\"{state}\",\"x\":{x},\"y\":{y},\"z\":{z}}}")
    }),
    ("object with an array", |i, [x, y, z]| format!("{{\"t\":{},\"acc\":[{x},{y},{z}]}}", i * 10)),
    ("ESP-IDF", |i, [x, y, z]| {
        format!("\u{1b}[0;32mI ({}) imu: x={x} y={y} z={z}\u{1b}[0m", 300 + i * 10)
    }),
    ("DMP of the MPU6050", |_, [x, y, z]| format!("ypr\t{x}\t{y}\t{z}")),
    ("NMEA", |_, [x, y, z]| checked(&format!("ACC,{x},{y},{z}"))),
    ("a counter", |i, [x, y, z]| format!("{i},{x},{y},{z}")),
    ("milliseconds", |i, [x, y, z]| format!("{};{x};{y};{z}", 5_000 + 10 * i)),
    ("microseconds that wrap", |i, [x, y, z]| {
        format!("{},{x},{y},{z}", (4_294_000_000 + 10_000 * i as u64) % (1 << 32))
    }),
    ("seconds", |i, [x, y, z]| format!("{:.2}\t{x}\t{y}\t{z}", 3.0 + 0.01 * i as f64)),
    ("seconds since 1970, whole", |i, [x, y, z]| {
        format!("{},{x},{y},{z}", 1_700_000_000 + i / 100)
    }),
    ("ISO 8601", |i, [x, y, z]| {
        format!("2024-03-01T10:00:{:02}.{:03}Z,{x},{y},{z}", i / 100, 10 * (i % 100))
    }),
    ("time of day of a terminal", |i, [x, y, z]| {
        format!("10:00:{:02}.{:03} -> {x},{y},{z}", i / 100, 10 * (i % 100))
    }),
    ("log of Python", |i, [x, y, z]| {
        format!("2024-03-01 10:00:{:02},{:03} INFO {x} {y} {z}", i / 100, 10 * (i % 100))
    }),
    ("a constant column and a word", |_, [x, y, z]| format!("imu_link,{x},{y},{z},0.0,OK")),
    ("boot log and header", |i, [x, y, z]| match i {
        0 => format!(
            "ets Jun  8 2016 00:22:57\n\nrst:0x1 (POWERON_RESET),boot:0x13 (SPI_FAST_FLASH_BOOT)\n\
             load:0x3fff0030,len:1184\nload:0x40078000,len:13232\nload:0x40080400,len:3028\n\
             entry 0x400805e4\nMPU6050 connection successful\nx,y,z\n{x},{y},{z}"
        ),
        200 => format!("WiFi connected, IP: 192.168.1.7\nx,y,z\n{x},{y},{z}"),
        _ => format!("{x},{y},{z}"),
    }),
];

fn f(text: &str) -> f64 {
    text.parse().unwrap()
}

fn checked(text: &str) -> String {
    format!("${text}*{:02X}", text.bytes().fold(0, |sum, byte| sum ^ byte))
}

#[test]
fn every_form_gives_the_printed_numbers_in_their_order_and_no_others() {
    for (name, print) in FORMS {
        let row = |i: usize| numbers(i).map(|x| format!("{x:.2}"));
        let text: Vec<String> = (0..ROWS).map(|i| print(i, row(i))).collect();
        let expected: Vec<Vec<f32>> =
            (0..ROWS).map(|i| numbers(i).map(|x| x as f32).to_vec()).collect();
        let got = learnt(&text);
        let first = got.iter().zip(&expected).find(|(got, expected)| got != expected);
        assert_eq!(first, None, "{name}: {:?} {:?}", &text[..3], survey(&text).columns());
        assert_eq!(got.len(), ROWS, "{name}: {:?}", &text[..3]);
    }
}

#[test]
fn the_examples_of_the_page_on_sensors_hold() {
    let page = include_str!("../../configs/README.md");
    let examples: Vec<_> = page.lines().filter_map(|line| line.split_once(" → ")).collect();
    assert!(examples.len() >= 15, "{examples:?}");
    for (line, row) in examples {
        let line = line.trim().replace(" ⏎ ", "\n");
        let expected: Vec<f32> = row.split_whitespace().map(|x| f(x) as f32).collect();
        let places = (1..=expected.len()).map(Column::Place).collect();
        let (got, refused) = frames(places, &vec![line.clone(); 6]);
        assert_eq!(got.last(), Some(&expected), "{line}: {refused:?}");
    }
}

fn repeated(lines: &[&str]) -> Vec<String> {
    (0..60).map(|i| lines[i % lines.len()].to_string()).collect()
}

#[test]
fn what_has_two_readings_is_an_error_that_shows_both() {
    let both = [
        &["0,12,9,81", "0,05,9,80"][..],
        &["1,2 3,4"],
        &["512,498 601,330"],
        &["1.234,56;2.000,10"],
        // Marks of thousands, beside numbers that lack them.
        &["1,982.19;-97", "1,982.19;5"],
        &["F: 1,982.19 N"],
        &["-97;999", "-50;1,000"],
        &["6,411\t99,446"],
        &["1.280,486"],
        &["-97;999", "-50;1.000"],
        &["x:999 y:5", "y:6 x:1.000"],
    ];
    for lines in both {
        let text = repeated(lines);
        let (_, refused) = frames(vec![Column::Place(1)], &text);
        let why = refused.unwrap_or_else(|| panic!("{lines:?}"));
        assert!(why.contains("decimal = \",\"") && why.contains(" | "), "{why}");
        let survey = survey(&text);
        let told = survey.problem().unwrap_or_else(|| survey.remarks().join("; "));
        assert!(told.contains("decimal = \",\""), "{lines:?} {told}");
    }
    let (_, refused) = frames(vec![Column::Place(1)], &repeated(&["0,12,9,81", "0,05,9,80"]));
    let why = refused.unwrap();
    assert!(why.contains("0 | 5 | 9 | 80") && why.contains("0.05 | 9.8"), "{why}");
    let (_, refused) = frames(vec![Column::Place(1)], &repeated(&["4;1,000"]));
    let why = refused.unwrap();
    assert!(why.contains("4 | 1 | 0, or with decimal commas 4 | 1, or with marks"), "{why}");
    let (_, refused) = frames(vec![Column::Place(1)], &repeated(&["1.280,486"]));
    let why = refused.unwrap();
    assert!(why.contains("1.28 | 486") && why.contains("commas 1280.486"), "{why}");
}

#[test]
fn a_cell_that_is_damaged_is_missing_and_never_a_number() {
    for cell in [
        "nan", "NaN", "-nan", "inf", "-inf", "ovf", "null", "", "-", " - ", "1.2.3", "1-2", "0x",
        "1e999", "imu_link", "1x3", "\u{b5}",
    ] {
        let mut text = vec!["1.5,2.5,3.5".to_string(); 30];
        text.push(format!("1.5,{cell},3.5"));
        let (all, _) = frames(vec![Column::Place(2)], &text);
        assert!(all[30][0].is_nan() && all.len() == 31, "{cell}: {:?}", &all[29..]);
        // The others keep their places.
        let (others, _) = frames(vec![Column::Place(1), Column::Place(3)], &text);
        assert_eq!(others[30], [1.5, 3.5], "{cell}");
    }
}

#[test]
fn a_line_of_another_form_is_no_row() {
    let others = [
        ("1,2,3", "1,2"),
        ("1,2,3", "1,2,3,4"),
        ("1.5g,2.5g", "1.5mg,2.5g"),
        ("(1, 2)", "[1, 2]"),
        ("ypr 1 2", "rpy 1 2"),
        ("$ACC,1,2*42", "$ACC,1,7*42"),
        ("$ACC,1,2", "$GYR,1,2"),
        ("x:1 y:2", "x:1"),
        ("x:1 y:2", "x:1 y:2mm"),
        ("U: 290 mV", "U: 0.78 V"),
        ("U: 290 mN, V: 1", "U: 0.78 kN, V: 1"),
        // Lost line ends, and a damaged row.
        ("-0.2888,700", "-0.2888,700-0.2882,701"),
        ("0.1,702", "0.1,7020.1,703"),
        ("0.12,9.81", "0.12,9.8q1.3,9.82"),
        ("0.12,9.81", "q.12,9.81,9.82"),
    ];
    for (usual, other) in others {
        let mut text = vec![usual.to_string(); 30];
        text.push(other.into());
        text.push(usual.into());
        let (all, _) = frames(survey(&text[..30]).measuring(), &text);
        let damaged = all.iter().filter(|row| row.iter().any(|x| x.is_nan())).count();
        assert_eq!((all.len(), damaged), (32, 1), "{usual} {other} {:?}", &all[28..]);
    }
}

#[test]
fn a_name_that_is_lost_mixes_no_rows() {
    let (mut text, mut expected) = (Vec::new(), Vec::new());
    for i in 0..200 {
        for (at, name) in ["x", "y", "z"].into_iter().enumerate() {
            if (i * 3 + at) % 17 != 5 || i < 10 {
                text.push(format!(">{name}:{}", i * 10 + at));
            }
        }
        expected.push(i as f32 * 10.0);
    }
    let columns = vec![Column::Place(1), Column::Place(2), Column::Place(3)];
    let (all, _) = frames(columns, &text);
    for row in all.iter().filter(|row| row.iter().all(|x| !x.is_nan())) {
        assert!(row[1] == row[0] + 1.0 && row[2] == row[0] + 2.0, "{row:?}");
    }
    assert!(all.len() >= 198, "{}", all.len());
}

#[test]
fn hexadecimal_needs_its_0x() {
    let (all, _) = frames(vec![Column::Place(1), Column::Place(2)], &repeated(&["0x1F 0xff"]));
    assert_eq!(all.last().unwrap()[..], [31.0, 255.0]);
    let (all, _) = frames(vec![Column::Place(1)], &repeated(&["1F,20", "A3,1C", "7,8D"]));
    assert!(all.iter().all(|row| row[0].is_nan()), "{all:?}");
}

#[test]
fn clocks_and_constant_columns_are_no_channels_and_that_is_said() {
    // The output of `ros2 topic echo --csv` for sensor_msgs/msg/Imu.
    let text: Vec<String> = (0..ROWS)
        .map(|i| {
            let ([x, y, z], zeros) = (numbers(i), ",0.0".repeat(9));
            let (sec, nanosec) = (1_700_000_000 + i / 100, i % 100 * 10_000_000);
            format!("{sec},{nanosec},imu_link,0.0,0.0,0.0,1.0{zeros},{y},{z},{x}{zeros},{x},{y},{z}{zeros}")
        })
        .collect();
    let survey = survey(&text);
    let places = [17, 18, 19, 29, 30, 31].map(Column::Place);
    assert_eq!(survey.measuring(), places);
    let said = survey.remarks();
    assert_eq!(said.len(), 3, "{said:?}");
    assert!(
        said[0].contains("columns 1, 2;")
            && said[1].contains("hold no numbers, so they are left out: columns 3")
            && said[2].contains("left out: columns 4, 5, 6"),
        "{said:?}"
    );
    // Seconds since 1970 set no channel's scale.
    let all = [1, 29, 30, 31].map(Column::Place);
    assert_eq!(survey.scale(&all), survey.scale(&places[3..]));
}

#[test]
fn where_no_form_lasts_the_lines_are_shown() {
    let forms = [["ACC,{},1", "GYR,{},2"], ["ax 0.{}", "ay 0.2{}"]];
    for lines in forms {
        let line = |i: usize| lines[i % 2].replace("{}", &(10 + i % 7).to_string());
        let text: Vec<String> = (0..60).map(line).collect();
        let said = survey(&text).problem().unwrap_or_default();
        assert!(said.contains(&text[0]) && said.contains(&text[1]), "{lines:?}: {said}");
    }
    let said = survey(&vec!["78:48:33".into(); 60]).problem().unwrap_or_default();
    assert!(said.contains("`78:48:33`"), "no time: {said}");
}

#[test]
fn quantities_that_share_names_in_turn_are_said() {
    let object = |i: usize| format!("{{\"type\":\"{}\",\"x\":{i}}}", ["acc", "gyr"][i % 2]);
    let below = |i: usize| format!("{}\nX: {i}\nY: {i}.5", ["Acceleration", "Gyroscope"][i % 2]);
    let state = |i: usize| format!("{{\"state\":\"{}\",\"x\":{i}}}", ["a", "b"][i / 5 % 2]);
    let said = |line: &dyn Fn(usize) -> String| {
        survey(&(0..ROWS).map(line).collect::<Vec<_>>()).remarks().join("; ")
    };
    assert!(said(&object).contains("`acc` and with `gyr` come in turn"), "{}", said(&object));
    assert!(said(&below).contains("`Acceleration` and with `Gyroscope`"), "{}", said(&below));
    assert!(!said(&state).contains("in turn"), "{}", said(&state));
}

#[test]
fn columns_with_few_numbers_are_said() {
    let cell =
        |i: usize| if i.is_multiple_of(2) { "nan".into() } else { format!("{:.2}", numbers(i)[1]) };
    let text: Vec<String> =
        (0..ROWS).map(|i| format!("{:.2},{},nan", numbers(i)[0], cell(i))).collect();
    let said = survey(&text).remarks().join("; ");
    assert!(said.contains("up to 50 % of the rows") && said.ends_with("columns 2"), "{said}");
    assert!(said.contains("hold no numbers, so they are left out: columns 3"), "{said}");
}

#[test]
fn lines_that_do_not_fit_are_shown_beside_one_that_does() {
    let text: Vec<String> = (0..ROWS)
        .map(|i| match i % 5 {
            0 => "free heap 23456".into(),
            _ => numbers(i).map(|x| x.to_string()).join(","),
        })
        .collect();
    let said = survey(&text).remarks();
    assert!(
        said[0].contains("only 80 %") && said[0].contains("`free heap 23456` is not"),
        "{said:?}"
    );
}

proptest! {
    #[test]
    fn numbers_come_back_as_they_were_printed_or_not_at_all(
        form in any::<[u8; 6]>(), rows in prop::collection::vec(any::<[i16; 3]>(), 0..40),
    ) {
        let numbers = rows.iter().flatten().flat_map(|x| x.to_le_bytes());
        printed_lines::check(&form.into_iter().chain(numbers).collect::<Vec<_>>());
    }

    #[test]
    fn any_bytes_are_survived(
        bytes in prop::collection::vec(
            prop_oneof![any::<u8>(), prop::sample::select(b"\n\n,; \t.-1eE:=nax[{}](|$*/\"".to_vec())],
            0..400,
        ),
    ) {
        printed_lines::check(&bytes);
    }
}
