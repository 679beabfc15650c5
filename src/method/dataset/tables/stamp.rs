//! Times of rows: numbers in some unit since a start, since 1970 or in Excel's days, dates of the
//! calendar, and times of the day.

use std::ops::Range;

use super::cell::{is_missing, shown};

/// Seconds since 1970 that say when: from 1998 to 2065.
pub(super) const SINCE_1970_S: Range<f64> = 9e8..3e9;

const S: f64 = 1e9;
const DAY: i64 = 86_400_000_000_000;

/// The form of the times in a column.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Stamps {
    /// Numbers in this unit, in nanoseconds; `since_1970` if they say when.
    Numbers { unit_ns: f64, since_1970: bool },
    /// Excel's days, with the day of 1970-01-01.
    Days { first: f64 },
    /// Dates with a time, such as ISO 8601; of `1/2/2024`, the day or the month is the first.
    Dates { day_first: bool, have_zone: bool },
    /// Times without a date, which begin anew after this many nanoseconds.
    Clock { lasts: i64 },
}

/// Units of time by their names, in nanoseconds.
const UNITS: [(&[&str], f64); 6] = [
    (&["s", "sec", "secs", "second", "seconds", "sek", "sekunden"], S),
    (&["ms", "msec", "millis", "millisecond", "milliseconds", "millisekunden"], 1e6),
    (&["us", "µs", "μs", "usec", "micros", "microsecond", "microseconds"], 1e3),
    (&["ns", "nsec", "nanos", "nanosecond", "nanoseconds"], 1.0),
    (&["min", "minute", "minutes"], 60.0 * S),
    (&["h", "hour", "hours"], 3600.0 * S),
];

pub(crate) fn unit_ns(name: &str) -> Option<f64> {
    let name = name.trim().to_lowercase();
    UNITS.iter().find(|(names, _)| names.contains(&&*name)).map(|(_, unit)| *unit)
}

impl Stamps {
    /// Finds out what the first times of a table mean, and says why. `unit_ns` is their unit if it is
    /// known; `from_1904` says from when Excel counts. Fails if they have no known form, or may have
    /// several units.
    pub(crate) fn of(
        cells: &[Vec<u8>],
        unit_ns: Option<f64>,
        from_1904: bool,
    ) -> Result<(Self, String), String> {
        let first = cells.iter().find(|cell| !is_missing(cell));
        let Some(first) = first else { return Err("holds no times".into()) };
        if is_date(first) {
            let reads = |day_first| move |cell: &Vec<u8>| date(cell, day_first).is_some();
            // One day after the twelfth shows it for all.
            let day_first = !cells.iter().all(reads(false)) && cells.iter().all(reads(true));
            let have_zone = date(first, day_first).is_some_and(|(_, zone)| zone);
            return Ok((Self::Dates { day_first, have_zone }, "dates".into()));
        }
        if let Some((_, lasts)) = time_of_day(first) {
            return Ok((Self::Clock { lasts }, "times of the day".into()));
        }
        let mut values = Vec::new();
        for cell in cells.iter().filter(|cell| !is_missing(cell)) {
            let value = number(cell).ok_or_else(|| format!("holds `{}`, no time", shown(cell)))?;
            values.push(value);
        }
        let mut steps: Vec<f64> = values.windows(2).map(|two| two[1] - two[0]).collect();
        steps.retain(|step| *step > 0.0);
        steps.sort_by(f64::total_cmp);
        let step = steps.get(steps.len() / 2).copied().unwrap_or(0.0);
        let level = values[0].abs();
        let since_1970 = |unit_ns: f64| SINCE_1970_S.contains(&(level * unit_ns / S));
        if let Some(unit_ns) = unit_ns {
            let stamps = Self::Numbers { unit_ns, since_1970: since_1970(unit_ns) };
            return Ok((stamps, format!("in units of {}", length(unit_ns))));
        }
        // A rate of 0.2 to 20,000 rows a second tells the units of large values apart.
        let epoch = [S, 1e6, 1e3, 1.0].into_iter().find(|&unit| since_1970(unit));
        if let Some(unit_ns) = epoch
            && (5e4..5.0 * S).contains(&(step * unit_ns))
        {
            let stamps = Self::Numbers { unit_ns, since_1970: true };
            return Ok((stamps, format!("in {} since 1970, by their values", length(unit_ns))));
        }
        if (30_000.0..80_000.0).contains(&level) && step > 0.0 && step < 1.2e-4 {
            let first = if from_1904 { 24_107.0 } else { 25_569.0 };
            let year = if from_1904 { 1904 } else { 1900 };
            return Ok((Self::Days { first }, format!("in Excel's days since {year}")));
        }
        let is_whole = values.iter().all(|value| value.fract() == 0.0);
        let counts = values.windows(2).all(|two| two[1] - two[0] == 1.0);
        let unit_ns = match step {
            _ if is_whole && counts && values[0] < 2.0 => {
                return Err(
                    "counts by 1, which may be milliseconds or rows; say --time-unit 0.001 for \
                            milliseconds, or --rate HZ"
                        .into(),
                );
            }
            _ if step <= 0.0 => return Err("does not rise".into()),
            // The bounds leave out what two units make plausible rates of.
            // A shorter one is a share of a day or an hour as likely as of a second.
            step if !is_whole && (2e-5..0.2).contains(&step) => S,
            step if (1.0..100.0).contains(&step) => 1e6,
            step if (250.0..50_000.0).contains(&step) => 1e3,
            step if (250_000.0..5e9).contains(&step) => 1.0,
            step => {
                let [in_s, in_ms, in_us] = [S, 1e6, 1e3].map(|unit| {
                    let hz = format!("{:.4}", S / (step * unit));
                    hz.trim_end_matches('0').trim_end_matches('.').to_string()
                });
                return Err(format!(
                    "rises by {step} a row, which is {in_s} rows a second in s, {in_ms} in ms, {in_us} in \
                     µs; say --time-unit SECONDS, such as 0.001"
                ));
            }
        };
        let stamps = Self::Numbers { unit_ns, since_1970: false };
        Ok((stamps, format!("in {}, by their steps", length(unit_ns))))
    }

    /// The time in a cell, in nanoseconds; from 1970 on if the stamps say when.
    pub(super) fn read(&self, cell: &[u8]) -> Option<i64> {
        match *self {
            Self::Dates { day_first, .. } => Some(date(cell, day_first)?.0),
            Self::Clock { .. } => time_of_day(cell).map(|(time, _)| time),
            Self::Days { first } => in_range((number(cell)? - first) * DAY as f64),
            Self::Numbers { unit_ns, .. } => {
                exact(cell, unit_ns).or_else(|| in_range(number(cell)? * unit_ns))
            }
        }
    }

    /// Whether the times say when the rows were recorded.
    pub(crate) fn say_when(&self) -> bool {
        match self {
            Self::Numbers { since_1970, .. } => *since_1970,
            Self::Days { .. } | Self::Dates { .. } => true,
            Self::Clock { .. } => false,
        }
    }
}

/// Whether a cell holds a time of the day.
pub(crate) fn is_clock(cell: &[u8]) -> bool {
    time_of_day(cell).is_some()
}

/// Whether a cell holds a date or a time of the day.
pub(crate) fn is_moment(cell: &[u8]) -> bool {
    is_date(cell) || is_clock(cell)
}

/// A unit of time by its name, or in seconds.
pub(crate) fn length(unit_ns: f64) -> String {
    match UNITS.iter().find(|(_, unit)| *unit == unit_ns) {
        Some((names, _)) => names[0].replace("us", "µs"),
        None => format!("{} s", unit_ns / S),
    }
}

fn is_date(cell: &[u8]) -> bool {
    [false, true].into_iter().any(|day_first| date(cell, day_first).is_some())
}

fn in_range(ns: f64) -> Option<i64> {
    (ns.abs() < 9.2e18).then_some(ns.round() as i64)
}

/// A number with a decimal point or a decimal comma.
fn number(cell: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(cell).ok()?;
    let value = text.parse::<f64>().or_else(|_| text.replace(',', ".").parse()).ok()?;
    value.is_finite().then_some(value)
}

/// A plain decimal number times a whole unit, without the rounding of floating point: nanoseconds since
/// 1970 take more digits than f64 has.
fn exact(cell: &[u8], unit_ns: f64) -> Option<i64> {
    if unit_ns.fract() != 0.0 || !(1.0..1e13).contains(&unit_ns) {
        return None;
    }
    let (digits, sign) = match cell {
        [b'-', rest @ ..] => (rest, -1),
        rest => (rest, 1),
    };
    let (mut ns, mut unit, mut is_fraction) = (0_i64, unit_ns as i64, false);
    for &byte in digits {
        match byte {
            b'.' | b',' if !is_fraction => {
                is_fraction = true;
                ns = ns.checked_mul(unit)?;
            }
            b'0'..=b'9' if !is_fraction => {
                ns = ns.checked_mul(10)?.checked_add(i64::from(byte - b'0'))?;
            }
            b'0'..=b'9' => {
                // Parts of a nanosecond are dropped.
                let digit = i64::from(byte - b'0') * unit;
                ns = ns.checked_add(digit / 10)?;
                unit /= 10;
            }
            _ => return None,
        }
    }
    let ns = if is_fraction { ns } else { ns.checked_mul(unit)? };
    (!digits.is_empty()).then_some(sign * ns)
}

/// Days from 1970-01-01 to a date. Days beyond a month's end count on into the next month.
fn days(year: i64, month: i64, day: i64) -> Option<i64> {
    if !(1900..2200).contains(&year) || !(1..=31).contains(&day) {
        return None;
    }
    let first = jiff::civil::Date::new(year as i16, i8::try_from(month).ok()?, 1).ok()?;
    Some(first.duration_since(jiff::civil::date(1970, 1, 1)).as_hours() / 24 + day - 1)
}

const MONTHS: [&str; 12] =
    ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"];

/// A date with a time: `2024-01-31T12:00:00.5+01:00`, `31.01.2024 12:00:00,5`, `1/31/2024 1:00:00 PM`,
/// `31-Jan-2024 12:00:00`. In ns since 1970, in local time if no zone is said; and whether one is.
fn date(cell: &[u8], day_first: bool) -> Option<(i64, bool)> {
    let text = std::str::from_utf8(cell).ok()?.trim();
    let (day, time) = text.split_once(['T', ' ', '_'])?;
    let mark = day.chars().find(|c| ['-', '/', '.'].contains(c))?;
    let mut parts = day.splitn(3, mark);
    let mut part = || {
        let text = parts.next()?;
        let month = MONTHS.iter().position(|month| text.eq_ignore_ascii_case(month));
        let number = month.map(|at| at as u16 + 1).or_else(|| text.parse().ok());
        (text.len() <= 4).then(|| number.map(i64::from))?
    };
    let (a, b, c) = (part()?, part()?, part()?);
    let (year, month, day) = match mark {
        _ if a > 31 => (a, b, c),
        '/' if !day_first => (c, a, b),
        _ => (c, b, a),
    };
    let time = time.trim();
    let (bare, zone) = match time.rfind(['+', '-']) {
        Some(at) => (&time[..at], zone_ns(&time[at..])?),
        None => (time.trim_end_matches(['Z', 'z']).trim_end_matches("UTC"), 0),
    };
    let has_zone = bare.len() < time.len();
    let (time, lasts) = time_of_day(bare.trim().as_bytes())?;
    (lasts == DAY).then_some(())?;
    let ns = days(year, month, day)?.checked_mul(DAY)?.checked_add(time - zone)?;
    Some((ns, has_zone))
}

/// The zone `+01:00`, `-0530` or `+01` in nanoseconds.
fn zone_ns(text: &str) -> Option<i64> {
    let sign = if text.starts_with('-') { -1 } else { 1 };
    let digits: String = text.chars().skip(1).filter(|c| *c != ':').collect();
    let two = |range| digits.get(range).and_then(|two: &str| two.parse::<u8>().ok()).map(i64::from);
    let minutes = if digits.len() > 2 { two(2..4)? } else { 0 };
    (digits.len() <= 4).then_some(sign * (two(0..2)? * 60 + minutes) * 60_000_000_000)
}

/// `12:34:56.789`, with `AM` or `PM` or not, or `34:56.7` (minutes and seconds), and after how long it
/// begins anew, in ns.
fn time_of_day(cell: &[u8]) -> Option<(i64, i64)> {
    let text = std::str::from_utf8(cell).ok()?.trim();
    // A length of time, as pandas writes it.
    if let Some((days, time)) = text.split_once(" days ") {
        let (time, _) = time_of_day(time.trim_start_matches('+').as_bytes())?;
        return Some((days.parse::<i64>().ok()?.checked_mul(DAY)?.checked_add(time)?, DAY));
    }
    let half = text.get(text.len().saturating_sub(2)..).map(str::to_ascii_uppercase);
    let (text, afternoon) = match half.as_deref() {
        Some("AM") => (text[..text.len() - 2].trim_end(), Some(0)),
        Some("PM") => (text[..text.len() - 2].trim_end(), Some(12)),
        _ => (text, None),
    };
    let parts: Vec<&str> = text.split(':').collect();
    let whole = |text: &str, most: i64| {
        let is_number = (1..=2).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
        let value = is_number.then(|| text.parse::<i64>().ok()).flatten()?;
        (value <= most).then_some(value)
    };
    let (hours, minutes, seconds, fraction) = match parts[..] {
        [h, m, s] => (Some(h), m, s, None),
        [h, m, s, thousandths] if thousandths.len() == 3 => (Some(h), m, s, Some(thousandths)),
        [m, s] if s.contains(['.', ',']) => (None, m, s, None),
        [h, m] if afternoon.is_some() => (Some(h), m, "0", None),
        _ => return None,
    };
    let (seconds, part) =
        seconds.split_once(['.', ',']).unwrap_or((seconds, fraction.unwrap_or("0")));
    let is_fraction = !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit());
    let part = is_fraction.then(|| exact(format!("0.{part}").as_bytes(), S)).flatten()?;
    let hours = match (hours.map(|hours| whole(hours, 23)), afternoon) {
        (None, None) => 0,
        (Some(hours), None) => hours?,
        (Some(hours), Some(more)) => hours? % 12 + more,
        (None, Some(_)) => return None,
    };
    let time = (hours * 60 + whole(minutes, 59)?) * 60 + whole(seconds, 60)?;
    let lasts = if parts.len() == 2 && afternoon.is_none() { DAY / 24 } else { DAY };
    Some((time * S as i64 + part, lasts))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(cells: &[&str]) -> Result<Stamps, String> {
        let cells: Vec<Vec<u8>> = cells.iter().map(|cell| cell.as_bytes().to_vec()).collect();
        Stamps::of(&cells, None, false).map(|(stamps, _)| stamps)
    }

    #[test]
    fn times_are_understood_by_their_values() {
        // The step of each is 5 ms, except of the whole seconds.
        for cells in [
            ["0.000", "0.005", "0.010"],
            ["0,000", "0,005", "0,010"],
            ["12345", "12350", "12355"],
            ["12345000", "12350000", "12355000"],
            ["12345000000", "12350000000", "12355000000"],
            ["1700000000.125", "1700000000.130", "1700000000.135"],
            ["1700000000125", "1700000000130", "1700000000135"],
            ["1700000000125000", "1700000000130000", "1700000000135000"],
            ["1700000000125000000", "1700000000130000000", "1700000000135000000"],
            ["2024-01-31T23:59:59.995Z", "2024-02-01T00:00:00.000Z", "2024-02-01T00:00:00.005Z"],
            ["31.01.2024 12:00:00,995", "31.01.2024 12:00:01,000", "31.01.2024 12:00:01,005"],
            ["12/06/2024 23:59:59.995", "13/06/2024 00:00:00", "13/06/2024 00:00:00.005"],
            ["12-Jun-2024 12:00:00.000", "12-Jun-2024 12:00:00.005", "12-Jun-2024 12:00:00.010"],
            ["1/31/2024 0:59:59.995 PM", "1/31/2024 1:00:00 PM", "1/31/2024 1:00:00.005 PM"],
            ["23:04:05.995", "23:04:06.000", "23:04:06.005"],
            ["23:04:05:995", "23:04:06:000", "23:04:06:005"],
            ["04:05.995", "04:06.000", "04:06.005"],
        ] {
            let stamps = of(&cells).unwrap();
            let times = cells.map(|cell| stamps.read(cell.as_bytes()).unwrap());
            assert_eq!([times[1] - times[0], times[2] - times[1]], [5_000_000; 2], "{cells:?}");
        }
        let days = of(&["45000.5", "45000.5000000579", "45000.5000001157"]).unwrap();
        let times = ["45000.5", "45000.5000001157"].map(|cell| days.read(cell.as_bytes()).unwrap());
        assert!((times[1] - times[0] - 10_000_000).abs() < 10_000, "{times:?}");
        // `date -u -d 2023-03-15T12:00:00 +%s`
        assert_eq!(times[0] / 1_000_000_000, 1_678_881_600);
        let iso = of(&["2023-03-15T13:00:00+01:00"]).unwrap();
        assert_eq!(iso.read(b"2023-03-15 14:30:00.25+02:30"), Some(1_678_881_600_250_000_000));
    }

    #[test]
    fn times_of_several_readings_or_none_are_refused() {
        for (cells, part) in [
            (["0", "100", "200"], "10 in ms"),
            (["0", "0.5", "1"], "2 rows a second in s"),
            (["0", "1", "2"], "milliseconds or rows"),
            (["1", "1", "1"], "does not rise"),
            (["0.5", "0.500000116", "0.500000231"], "say --time-unit"),
            (["a", "b", "c"], "holds `a`, no time"),
        ] {
            let said = of(&cells).unwrap_err();
            assert!(said.contains(part), "{said}");
        }
        let seconds = Stamps::Numbers { unit_ns: S, since_1970: false };
        for cell in ["1e300", "99999999999999999999", "", "-", "inf", "2024-13-01 00:00:00"] {
            assert_eq!(seconds.read(cell.as_bytes()), None, "{cell}");
            let dates = Stamps::Dates { day_first: false, have_zone: true };
            assert_eq!(dates.read(cell.as_bytes()), None, "{cell}");
        }
    }
}
