use super::*;
use crate::scene::SourceId;
use proptest::prelude::*;

fn stream(id: &str, columns: &[usize]) -> LinesStream {
    let columns = columns.iter().map(|place| Column::Place(*place)).collect();
    LinesStream { id: SourceId::new(id).unwrap(), columns, scale: Some(0.5) }
}

fn named(id: &str, columns: &[&str]) -> LinesStream {
    let columns = columns.iter().map(|name| Column::Name((*name).into())).collect();
    LinesStream { columns, ..stream(id, &[]) }
}

/// Feeds bytes, and appends the samples of each stream to `out`, with NaN for missing frames.
fn take(intake: &mut LinesIntake, bytes: &[u8], now_s: f64, out: &mut [Vec<f32>]) {
    let widths: Vec<_> = intake.streams.iter().map(|stream| stream.columns.len()).collect();
    intake.feed(bytes, now_s, |event| match event {
        LinesEvent::Frames { stream, samples } => out[stream].extend(samples),
        LinesEvent::Missing(frames) => {
            for (out, width) in out.iter_mut().zip(&widths) {
                out.extend(std::iter::repeat_n(f32::NAN, frames as usize * width));
            }
        }
    });
}

/// Samples and errors of a stream of one column that gets one of `texts` each millisecond.
fn alone(count: Option<Count>, texts: &[impl AsRef<str>]) -> (Vec<f32>, ErrorCounts) {
    let (mut intake, mut out) = of_column(1, count, 1000.0);
    for (at, text) in texts.iter().enumerate() {
        take(&mut intake, text.as_ref().as_bytes(), at as f64 * 1e-3, &mut out);
    }
    (out.remove(0), intake.errors)
}

/// An intake of a stream of one column, whose rows come at `rate_hz`; and no samples yet.
fn of_column(place: usize, count: Option<Count>, rate_hz: f64) -> (LinesIntake, Vec<Vec<f32>>) {
    (LinesIntake::new(vec![stream("x", &[place])], count, rate_hz), vec![Vec::new()])
}

fn missing(samples: &[f32]) -> usize {
    samples.iter().filter(|x| x.is_nan()).count()
}

#[test]
fn columns_become_channels_by_place_and_by_name() {
    let wanted = vec![stream("a", &[3, 1]), named("b", &["ay"])];
    let mut intake = LinesIntake::new(wanted, None, 1000.0);
    let mut out = vec![Vec::new(); 2];
    take(&mut intake, b"1,2,3\n", 0.0, &mut out);
    assert!(intake.refused.as_ref().unwrap().contains("no header"), "{:?}", intake.refused);
    take(&mut intake, b"ax,ay,az\n1,2,3\n4,5,6\n", 0.01, &mut out);
    assert_eq!(out, [vec![1.5, 0.5, 3.0, 2.0], vec![1.0, 2.5]]);
    assert_eq!(intake.refused, None);
    // The names give each stream its columns, even in another order.
    take(&mut intake, b"ay,ax,az\n7,8,9\n", 0.02, &mut out);
    assert_eq!((&out[1][..], intake.rows), (&[1.0, 2.5, 3.5][..], 3));
}

#[test]
fn a_header_moves_names_and_never_places_in_silence() {
    let wanted = |stream| LinesIntake::new(vec![stream], None, 1000.0);
    let (mut by_place, mut by_name) = (wanted(stream("x", &[1])), wanted(named("x", &["v"])));
    let (mut places, mut names) = (vec![Vec::new()], vec![Vec::new()]);
    // Neither units below the header nor words between the rows are names.
    for text in ["v,n\n", "g,mV\n", "1,2\n", "Error,retry\n", "3,4\n"] {
        take(&mut by_place, text.as_bytes(), 0.0, &mut places);
        take(&mut by_name, text.as_bytes(), 0.0, &mut names);
    }
    assert_eq!((&names[0][..], by_name.refused.as_ref()), (&[0.5, 1.5][..], None));
    let text = b"v,n\n1,2\nn,v\n5,6\n";
    take(&mut by_place, text, 0.0, &mut places);
    take(&mut by_name, text, 0.0, &mut names);
    assert!(by_place.swapped().unwrap().contains("v was column 1 and is now column 2"));
    assert_eq!((names[0].last(), by_name.swapped()), (Some(&3.0), None));
    // A header with one more column names the rows that follow.
    by_name.reopened(false);
    let text = "t,n,v\n".to_string() + &"7,8,9\n".repeat(30);
    take(&mut by_name, text.as_bytes(), 1.0, &mut names);
    take(&mut by_name, b"", 20.0, &mut names);
    assert_eq!((names[0].last(), by_name.refused.as_ref()), (Some(&4.5), None));
    take(&mut by_name, b"v,n,v\n1,2,3\n", 20.0, &mut names);
    assert!(by_name.refused.unwrap().contains("columns 1 and 3 are both called v"));
}

#[test]
fn a_line_that_cannot_be_used_is_a_missing_frame_and_has_a_count() {
    let long = "9".repeat(5000) + "\n";
    let texts = ["1,1\n", "\u{1}\u{2}?\n", "2,2\n", "nan,2\n", &long, "3\n", "4,4\n"];
    let (samples, counts) = alone(None, &texts);
    assert_eq!((samples.len(), missing(&samples)), (7, 4), "{samples:?}");
    assert_eq!([GARBAGE, TOO_LONG, OTHER_FORM, NOT_NUMBERS].map(|text| counts.0[text]), [1; 4]);
}

#[test]
fn a_counter_shows_losses_exactly_even_where_it_begins_again() {
    let rows = |column: usize| Some(Count::Rows(Column::Place(column)));
    let (samples, counts) = alone(rows(2), &["1,7\n", "2,8\n", "3,11\n", "x,12\n", "4,13\n"]);
    assert_eq!((samples.len(), missing(&samples)), (7, 3), "{samples:?}");
    assert_eq!([GAPS, LONGEST_GAP, RESTARTS].map(|text| counts.0[text]), [2, 2, 0]);
    // A counter of 8 bits, with one row lost where the counter starts again from 0.
    let (samples, counts) = alone(rows(2), &["1,254\n", "2,255\n", "3,1\n", "4,2\n"]);
    assert_eq!((missing(&samples), counts.0[RESTARTS]), (1, 0), "{samples:?}");
    let (samples, counts) = alone(rows(2), &["1,5000\n", "2,5001\n", "3,0\n", "4,1\n"]);
    assert_eq!(counts.0[RESTARTS], 1);
    // The gap at a restart is too long for a scan to bridge.
    assert!(missing(&samples) >= 2, "{samples:?}");
}

#[test]
fn rows_that_come_twice_or_out_of_order_are_dropped_and_are_no_restart() {
    let of = |numbers: &[u32]| {
        let texts: Vec<String> = numbers.iter().map(|number| format!("{number}\n")).collect();
        let (samples, counts) = alone(Some(Count::Rows(Column::Place(1))), &texts);
        (samples.len(), missing(&samples), counts.0[OUT_OF_ORDER], counts.0[RESTARTS])
    };
    assert_eq!(of(&[7, 8, 8, 9, 11, 10, 12]), (6, 1, 2, 0));
    let back: Vec<u32> = (0..6).chain(3..40).collect();
    assert_eq!(of(&back), (40, 0, 3, 0));
    // The row with the number 255 comes after the counter has begun again.
    let wraps: Vec<u32> = (0..256).chain(0..255).chain([0, 255, 1]).collect();
    assert_eq!(of(&wraps), (514, 1, 1, 0));
}

#[test]
fn microseconds_show_losses_whatever_their_jitter() {
    let micros = Some(Count::Micros(Column::Place(2)));
    // One row per 1000 µs: two rows are lost, and the counter of 32 bits starts again.
    let times = [4_294_964_296_u64, 4_294_965_290, 4_294_966_310, 2_000, 3_010];
    let texts: Vec<String> = times.iter().map(|t| format!("1,{t}\n")).collect();
    let (samples, counts) = alone(micros.clone(), &texts);
    assert_eq!((missing(&samples), counts.0[GAPS], counts.0[RESTARTS]), (2, 1, 0), "{samples:?}");
    // A row that comes late is not a row that is lost.
    let late = ["1,1000\n", "1,2000\n", "1,3900\n", "1,4050\n", "1,5000\n", "1,7000\n"];
    let (samples, counts) = alone(micros.clone(), &late);
    assert_eq!((missing(&samples), counts.0[GAPS]), (1, 1), "{samples:?}");
    let (_, counts) = alone(micros, &["1,5000000\n", "1,5001000\n", "1,900\n", "1,1900\n"]);
    assert_eq!(counts.0[RESTARTS], 1);
}

#[test]
fn without_a_counter_a_silence_is_counted_by_the_clock_and_a_delay_is_not() {
    let (mut intake, mut out) = of_column(1, None, 1000.0);
    take(&mut intake, b"1\n", 0.0, &mut out);
    // All of them were only late.
    take(&mut intake, "2\n".repeat(300).as_bytes(), 0.3, &mut out);
    assert_eq!((missing(&out[0]), out[0].len()), (0, 301));
    // After two seconds of silence, half a second of rows arrives late, and the rest is lost.
    take(&mut intake, "3\n".repeat(100).as_bytes(), 2.3, &mut out);
    take(&mut intake, "3\n".repeat(400).as_bytes(), 2.3, &mut out);
    assert_eq!(out[0].len(), 301, "not clear yet");
    take(&mut intake, b"", 2.6, &mut out);
    assert_eq!((missing(&out[0]), out[0].len()), (1500, 2301));
    assert!(out[0][301..1801].iter().all(|x| x.is_nan()), "the gap is where the silence was");
    intake.reopened(false);
    take(&mut intake, b"4\n", 2.7, &mut out);
    take(&mut intake, b"", 3.0, &mut out);
    // Rows 2301 to 2699.
    assert_eq!(missing(&out[0]), 1899);
}

#[test]
fn rows_that_come_in_bursts_do_not_count_twice() {
    // 12.5 Hz in blocks of some seconds, as by a pipe; 400 Hz by a network that stalls.
    for (rate_hz, every_s, parts) in [(12.5, 4.0, 1), (400.0, 1.7, 20), (400.0, 0.3, 3)] {
        let ((mut intake, mut out), mut sent) = (of_column(1, None, rate_hz), 0);
        for burst in 1..50 {
            let now_s = f64::from(burst) * every_s;
            let due = (now_s * rate_hz) as usize;
            for part in 1..=parts {
                let until = sent + (due - sent) * part / parts;
                let late_s = part as f64 * 5e-3;
                take(&mut intake, "1\n".repeat(until - sent).as_bytes(), now_s + late_s, &mut out);
                sent = until;
            }
        }
        take(&mut intake, b"", 300.0, &mut out);
        assert_eq!((missing(&out[0]), out[0].len()), (0, sent), "{rate_hz} Hz");
    }
}

#[test]
fn counters_of_any_length_lose_nothing_and_show_what_is_lost() {
    let powers = (2..=32).map(|bits| 1_u64 << bits);
    for (values, first) in powers
        .chain([100, 1000, 10_000, 99_999, 100_000])
        .flat_map(|values| [(values, 0), (values, 1)])
    {
        let rows = Some(Count::Rows(Column::Place(1)));
        let (mut intake, mut out) = of_column(2, rows, 1000.0);
        let start = values - 50.min(values);
        // A row is lost after the counter has begun again once, if it is short.
        let lost = |row: u64| row == 61 && values > 50;
        for row in (0..500).filter(|row| !lost(*row)) {
            let text = format!("{},1\n", first + (start + row) % values);
            take(&mut intake, text.as_bytes(), row as f64 * 1e-3, &mut out);
        }
        let expected = usize::from(values > 50);
        assert_eq!((missing(&out[0]), out[0].len()), (expected, 500), "{values} from {first}");
    }
}

#[test]
fn columns_that_change_for_good_are_followed() {
    let texts = [vec!["1,2\n"; 30], vec!["3,4,5\n"; 30]].concat();
    let (samples, counts) = alone(None, &texts);
    assert_eq!((counts.0[CHANGES], counts.0[OTHER_FORM]), (1, 19));
    assert_eq!((samples.len(), samples.last()), (60, Some(&1.5)));
    // Rows with too few columns are refused until the columns are back.
    let (mut intake, mut out) = of_column(2, None, 1000.0);
    take(&mut intake, "1\n".repeat(30).as_bytes(), 0.0, &mut out);
    assert!(intake.refused.as_ref().unwrap().contains("wants number 2"));
    take(&mut intake, "1,2\n".repeat(20).as_bytes(), 0.1, &mut out);
    assert_eq!((&intake.refused, &out[0][..]), (&None, &[1.0][..]));
    // So is a line that has two readings.
    take(&mut intake, b"9,05\n", 0.2, &mut out);
    assert!(intake.refused.as_ref().unwrap().contains("with decimal commas"));
    take(&mut intake, b"0.5,1.5\n", 0.3, &mut out);
    assert_eq!(intake.refused, None);
}

proptest! {
    #[test]
    fn any_bytes_are_survived_and_every_frame_is_whole(
        parts in prop::collection::vec(
            (prop::collection::vec(prop_oneof![
                any::<u8>(), prop::sample::select(b"\n\r,; \t.-1eE:naxy".to_vec()),
            ], 0..60), 0.0..3.0f64),
            0..20,
        ),
        counted in any::<bool>(),
    ) {
        let count = counted.then_some(Count::Rows(Column::Place(1)));
        let mut intake = LinesIntake::new(vec![stream("x", &[1, 2])], count, 100.0);
        let mut now_s = 0.0;
        for (bytes, later_s) in parts {
            now_s += later_s;
            intake.feed(&bytes, now_s, |event| match event {
                LinesEvent::Frames { samples, .. } => {
                    assert!(samples.len() % 2 == 0 && samples.iter().all(|x| x.is_finite()));
                }
                LinesEvent::Missing(frames) => assert!(frames <= 2_000, "{frames}"),
            });
        }
    }

    #[test]
    fn with_a_counter_every_row_has_its_index_whatever_is_lost(
        lost in prop::collection::vec(any::<bool>(), 2..400), bits in prop::sample::select(vec![8, 16, 32]),
    ) {
        let (mut intake, mut out) = of_column(2, Some(Count::Rows(Column::Place(1))), 1000.0);
        let start = (1_u64 << bits) - 100;
        for (index, _) in lost.iter().enumerate().filter(|(_, lost)| !**lost) {
            let text = format!("{},{index}\n", (start + index as u64) % (1 << bits));
            take(&mut intake, text.as_bytes(), index as f64 * 1e-3, &mut out);
        }
        let first = out[0].first().copied().unwrap_or(0.0);
        for (at, x) in out[0].iter().enumerate().filter(|(_, x)| !x.is_nan()) {
            prop_assert_eq!(*x - first, at as f32 * 0.5);
        }
    }
}
