//! Values of arguments that several commands take.

/// Longest drag in seconds: an hour.
const LONGEST_S: f64 = 3600.0;

/// Parses a positive number of seconds.
pub fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(x) if x > 0.0 && x <= LONGEST_S => Ok(x),
        _ => Err(format!("expected a positive number of seconds, at most {LONGEST_S}")),
    }
}

/// Parses a fraction.
pub fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(x) if x > 0.0 && x < 1.0 => Ok(x),
        _ => Err("expected a fraction above 0 and below 1, such as 0.01".into()),
    }
}
