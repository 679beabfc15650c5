//! Numbers and times at the beginning of a text, and units stuck to them.

use super::commas::is_grouped;

/// Digits that show whether points separate thousands: a whole number of three digits, a number
/// such as `1.234`, and one whose point can only be a decimal point.
pub(super) const WHOLE: u8 = 1;
pub(super) const GROUPED: u8 = 2;
pub(super) const FRACTION: u8 = 4;

pub(super) fn begins_number(text: &[u8]) -> bool {
    let text = text.strip_prefix(b"+").or(text.strip_prefix(b"-")).unwrap_or(text);
    matches!(text, [b'0'..=b'9', ..] | [b'.', b'0'..=b'9', ..])
}

/// Whether text stuck to a number can be its unit: letters, with digits only after `/` or `^`.
pub(super) fn is_stuck_unit(text: &[u8]) -> bool {
    const LONGEST: usize = 12;
    let letter = |byte: &u8| byte.is_ascii_alphabetic() || *byte >= 0x80 || *byte == b'%';
    let mark = |byte: &u8| matches!(byte, b'/' | b'^' | b'*' | b'.');
    let begins = text.first().is_some_and(letter) && text.last().is_some_and(|last| !mark(last));
    let power = text.iter().position(mark).unwrap_or(text.len());
    let (name, rest) = text.split_at(power);
    let fits = |byte: &u8| letter(byte) || mark(byte) || byte.is_ascii_digit();
    begins && text.len() <= LONGEST && name.iter().all(letter) && rest.iter().all(fits)
}

pub(super) fn digits_of(number: &[u8]) -> u8 {
    let unsigned = number.strip_prefix(b"-").or(number.strip_prefix(b"+")).unwrap_or(number);
    match unsigned.contains(&b'.') {
        true if is_grouped(unsigned, b'.', b',') => GROUPED,
        true => FRACTION,
        false if unsigned.len() == 3 && unsigned.iter().all(u8::is_ascii_digit) => WHOLE,
        false => 0,
    }
}

/// The number that `text` begins with, and its length. Thousands may have apostrophes, and with
/// decimal commas points. NaN stands for `0x` without digits.
pub(super) fn number_of(text: &[u8], decimal_comma: bool) -> (f64, usize) {
    let signed = usize::from(matches!(text[0], b'+' | b'-'));
    let negative = text[0] == b'-';
    if let [b'0', b'x' | b'X', digits @ ..] = &text[signed..] {
        let length = digits.iter().take_while(|byte| byte.is_ascii_hexdigit()).count();
        if length == 0 {
            return (f64::NAN, signed + 2);
        }
        let digits = digits[..length].iter().filter_map(|byte| char::from(*byte).to_digit(16));
        let value = digits.fold(0.0, |value, digit| value * 16.0 + f64::from(digit));
        return (if negative { -value } else { value }, signed + 2 + length);
    }
    let digits = |from: usize| text[from..].iter().take_while(|byte| byte.is_ascii_digit()).count();
    let mut at = signed + digits(signed);
    // The end of the integer part, if `mark` separates thousands.
    let grouped = |mark: u8| {
        let groups = text[at..].chunks(4).take_while(|group| {
            group.len() == 4 && group[0] == mark && group[1..].iter().all(u8::is_ascii_digit)
        });
        let end = at + 4 * groups.count();
        let fits = at - signed <= 3 && text[signed] != b'0' && digits(end) == 0;
        (fits && end > at).then_some(end)
    };
    let is_comma = |at: usize| decimal_comma && text.get(at) == Some(&b',') && digits(at + 1) > 0;
    let points = if decimal_comma { grouped(b'.').filter(|end| is_comma(*end)) } else { None };
    let marks = points.or(grouped(b'\''));
    at = marks.unwrap_or(at);
    let comma = is_comma(at).then_some(at);
    if comma.is_some() || text.get(at) == Some(&b'.') {
        at += 1 + digits(at + 1);
    }
    if let [b'e' | b'E', rest @ ..] = &text[at..] {
        let sign = usize::from(matches!(rest.first(), Some(b'+' | b'-')));
        let length = digits(at + 1 + sign);
        at += if length > 0 { 1 + sign + length } else { 0 };
    }
    let parsed =
        |number: &[u8]| std::str::from_utf8(number).ok().and_then(|text| text.parse().ok());
    let value = match comma.or(marks) {
        None => parsed(&text[..at]),
        // The longest line bounds the copy.
        Some(end) => {
            let is_mark = |byte: &u8| matches!(byte, b'.' | b'\'');
            let mut copy = text[..end].to_vec();
            copy.retain(|byte| !is_mark(byte));
            copy.extend_from_slice(&text[end..at]);
            copy.iter_mut().filter(|byte| **byte == b',').for_each(|byte| *byte = b'.');
            parsed(&copy)
        }
    };
    (value.unwrap_or(f64::NAN), at)
}

/// The time that `text` begins with, in seconds, and its length: a date and time in the form of ISO
/// 8601, since 1970 (UTC unless it has an offset), or a time of day, `12:34:56.789`, since midnight.
pub(super) fn time_of(text: &[u8]) -> Option<(f64, usize)> {
    let digits = |from: usize, to: usize| -> Option<f64> {
        let part = text.get(from..to)?;
        let all = part.iter().all(u8::is_ascii_digit);
        all.then(|| part.iter().fold(0.0, |sum, byte| sum * 10.0 + f64::from(byte - b'0')))
    };
    let is = |at: usize, mark: u8| text.get(at) == Some(&mark);
    let (mut at, mut days) = (0, None);
    if is(4, b'-') && is(7, b'-') {
        let (year, month, day) = (digits(0, 4)?, digits(5, 7)?, digits(8, 10)?);
        let date = jiff::civil::Date::new(year as i16, month as i8, day as i8).ok()?;
        days = Some((date.to_zoned(jiff::tz::TimeZone::UTC).ok()?.timestamp().as_second()) as f64);
        at = 10;
        if !matches!(text.get(at), Some(b'T' | b' ' | b'_' | b't'))
            || digits(at + 1, at + 3).is_none()
        {
            return days.map(|s| (s, at));
        }
        at += 1;
    } else if !(is(2, b':') && is(5, b':') || is(1, b':') && is(4, b':') && is(7, b'.')) {
        return None;
    }
    // Hours of one digit, as in `9:30:00.125`, end one place before.
    let colon = at + if days.is_none() && is(1, b':') { 1 } else { 2 };
    let clock = (digits(at, colon), is(colon, b':'), digits(colon + 1, colon + 3));
    let (Some(hours @ 0.0..24.0), true, Some(minutes @ 0.0..60.0)) = clock else {
        return days.map(|s| (s, at - 1));
    };
    let mut seconds = days.unwrap_or(0.0) + hours * 3600.0 + minutes * 60.0;
    at = colon + 3;
    if let Some(whole) = digits(at + 1, at + 3).filter(|_| is(at, b':')) {
        // A leap second is the 61st.
        if whole > 60.0 {
            return None;
        }
        seconds += whole;
        at += 3;
        let length = text.get(at + 1..).unwrap_or_default();
        let length = length.iter().take_while(|byte| byte.is_ascii_digit()).count();
        // `12:34:56,789 ` has milliseconds, and `12:34:56,789,5` another column.
        let ends =
            matches!(text.get(at + 4), Some(b' ' | b'\t' | b'Z' | b';' | b'|' | b']' | b'"'));
        let comma = is(at, b',') && length == 3 && ends;
        if is(at, b'.') || comma {
            let fraction = digits(at + 1, at + 1 + length.min(12))?;
            seconds += fraction / 10_u64.pow(length.min(12) as u32) as f64;
            at += usize::from(length > 0) + length;
            // Zephyr's `[00:00:00.020,037]` has microseconds after its milliseconds.
            if let Some(micros) = digits(at + 1, at + 4)
                && !comma
                && length == 3
                && is(at, b',')
                && is(at + 4, b']')
            {
                seconds += micros * 1e-6;
                at += 4;
            }
        }
    }
    if is(at, b'Z') {
        at += 1;
    } else if days.is_some() && (is(at, b'+') || is(at, b'-')) {
        let minutes_at = at + 3 + usize::from(is(at + 3, b':'));
        if let (Some(hours), minutes) = (digits(at + 1, at + 3), digits(minutes_at, minutes_at + 2))
        {
            let offset = hours * 3600.0 + minutes.unwrap_or(0.0) * 60.0;
            seconds -= if is(at, b'-') { -offset } else { offset };
            at = minutes.map_or(at + 3, |_| minutes_at + 2);
        }
    }
    Some((seconds, at))
}
