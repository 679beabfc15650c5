//! Colour of pixels, as the comparison sees it.

/// Hue (in turns, 0 to below 1), saturation and value (0 to 1) of 8-bit red, green and blue.
///
/// Grey has hue 0 and saturation 0, black also value 0 (Smith 1978, "Color gamut transform
/// pairs", as MATLAB's `rgb2hsv`).
pub fn hsv(rgb: [u8; 3]) -> [f64; 3] {
    let [r, g, b] = rgb.map(|x| f64::from(x) / 255.0);
    let max = r.max(g).max(b);
    let min = r.min(g).min(b);
    let span = max - min;
    if span == 0.0 {
        return [0.0, 0.0, max];
    }
    let sixths = if max == r {
        (g - b) / span
    } else if max == g {
        2.0 + (b - r) / span
    } else {
        4.0 + (r - g) / span
    };
    [(sixths / 6.0).rem_euclid(1.0), span / max, max]
}
