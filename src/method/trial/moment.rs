//! Moments as numbers and as text.

use std::time::{SystemTime, UNIX_EPOCH};

use jiff::Timestamp;

/// Milliseconds from 1970 to `moment`; 0 for a moment before 1970.
pub fn unix_ms(moment: SystemTime) -> u64 {
    moment.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

/// A moment as text in UTC, to the second, such as `2025-01-31T12:00:00Z` (RFC 3339). A moment
/// outside the years -9999 to 9999 counts as 1970.
pub fn utc(moment: SystemTime) -> String {
    let whole = Timestamp::try_from(moment)
        .and_then(|moment| Timestamp::from_second(moment.as_second()))
        .unwrap_or(Timestamp::UNIX_EPOCH);
    whole.to_string()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn moments_become_calendar_dates() {
        let at = |seconds| utc(UNIX_EPOCH + Duration::from_secs_f64(seconds));
        // The expected texts are those of `date -u -d @SECONDS`.
        assert_eq!(at(0.0), "1970-01-01T00:00:00Z");
        assert_eq!(at(951_782_399.9), "2000-02-28T23:59:59Z");
        assert_eq!(at(951_782_400.0), "2000-02-29T00:00:00Z");
        assert_eq!(at(1_735_689_599.0), "2024-12-31T23:59:59Z");
        assert_eq!(at(4_107_542_400.0), "2100-03-01T00:00:00Z");
    }
}
