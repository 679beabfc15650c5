use super::*;

#[test]
fn a_series_that_grows_is_counted_like_a_whole_one() {
    let values: Vec<f32> = frames(80, 0.0).into_iter().chain(frames(9, -20.0)).collect();
    let mut grown = Counts::new(2, 6);
    values.chunks(7 * 6).for_each(|piece| grown.add(piece));
    let whole = counted(&values);
    assert_eq!(grown.frames, whole.frames);
    for (x, y) in grown.ln_mean_power().iter().zip(whole.ln_mean_power()) {
        assert!((x - y).abs() < 1e-6);
    }
    let mean = (values.iter().map(|&x| f64::from(x).exp()).sum::<f64>() / values.len() as f64).ln();
    let powers = whole.ln_mean_power().iter().map(|x| x.exp()).sum::<f64>() / 2.0;
    assert!((powers.ln() - mean).abs() < 3e-3);
    assert_eq!(counted(&[]).frames, 0);
}

/// Frames of two channels with three bands each.
fn frames(n: usize, louder: f32) -> Vec<f32> {
    (0..6 * n).map(|i| ((i * 7919) % 1000) as f32 / 250.0 - 5.0 + louder).collect()
}

fn counted(values: &[f32]) -> Counts {
    let mut counts = Counts::new(2, 6);
    counts.add(values);
    counts
}

#[test]
fn features_are_means_of_cosines_and_sines_of_each_band() {
    let values = frames(300, 0.0);
    let embedder = ViewEmbedder::new(&[counted(&values)]);
    let mut vector = Vec::new();
    embedder.push(&counted(&values), 0.0, &mut vector);
    assert_eq!(vector.len(), embedder.dims());
    // From the definition, in shape, for band 4, which belongs to the second channel.
    let power = |c: usize| {
        let of_channel = values.chunks_exact(6).flat_map(|row| &row[3 * c..3 * c + 3]);
        of_channel.map(|&x| f64::from(x).exp()).sum::<f64>() / 900.0
    };
    let relative: Vec<f64> = (values.iter().skip(4).step_by(6))
        .map(|&x| (f64::from(x).exp() / power(1) + FLOOR).ln())
        .collect();
    let mean = relative.iter().sum::<f64>() / 300.0;
    let deviation =
        (relative.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 300.0).sqrt() + 1e-3;
    let z = |x: &f64| (x - mean) / deviation;
    let cos = relative.iter().map(|x| (0.6 * z(x)).cos()).sum::<f64>() / 300.0;
    let sin2 = relative.iter().map(|x| (1.2 * z(x)).sin()).sum::<f64>() / 300.0;
    assert!((f64::from(vector[4]) - cos).abs() < 2e-3, "{} vs {cos}", vector[4]);
    assert!((f64::from(vector[18 + 4]) - sin2).abs() < 2e-3, "{} vs {sin2}", vector[22]);
}

#[test]
fn a_gain_moves_the_level_and_not_the_shape() {
    let embedder = ViewEmbedder::new(&[counted(&frames(200, 0.0)), counted(&frames(200, 1.0))]);
    let vector = |values: &[f32], ln_gain: f64| {
        let mut vector = Vec::new();
        embedder.push(&counted(values), ln_gain, &mut vector);
        vector
    };
    let (quiet, loud) = (vector(&frames(200, 0.0), 0.0), vector(&frames(200, 2.0), 0.0));
    let played = vector(&frames(200, 0.0), 1.0);
    let near = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3);
    assert!(near(&quiet[..24], &loud[..24]) && !near(&quiet[24..], &loud[24..]));
    assert!(near(&played, &loud));
}
