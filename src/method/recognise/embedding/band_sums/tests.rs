use super::*;

#[test]
fn a_whole_series_is_counted_as_if_it_had_grown() {
    for (n, width) in [(0, 6), (1, 6), (2, 6), (7, 2), (240, 6)] {
        // Steps of 1/512, like packed frames, so that counts are the same to the last bit.
        let step = |i: usize| ((i * 7919) % 4096) as f32 / 512.0;
        let off = |i: usize| if i / width % 5 == 3 { 9.0 } else { (i / width % 3) as f32 };
        let values: Vec<f32> = (0..n * width).map(|i| step(i) - off(i)).collect();
        let (mut grown, mut whole) = (Counts::new(2, width), Counts::new(2, width));
        values.chunks(3 * width).for_each(|piece| grown.add(piece));
        whole.add(&values);
        assert_eq!((grown.frames, grown.first), (whole.frames, whole.first), "{n}");
        assert_eq!(grown.ln_mean_power(), whole.ln_mean_power(), "{n}");
        let bins = (grown.bins.max(1), whole.bins.max(1));
        let bands = grown.counts.chunks(bins.0).zip(whole.counts.chunks(bins.1));
        for (grown, whole) in bands {
            let shared = grown.len().min(whole.len());
            assert_eq!(grown[..shared], whole[..shared], "{n}");
            assert!(grown[shared..].iter().chain(&whole[shared..]).all(|x| *x == 0.0));
        }
    }
}

#[test]
fn a_quiet_frame_counts_like_any_other_whatever_the_gain() {
    for gain in [0.0, -12.0, 7.5] {
        let values = [0.0, 0.2, -20.0, -19.8].map(|x: f32| x + gain);
        let mut counts = Counts::new(1, 2);
        counts.add(&values);
        let power: f64 = values.iter().map(|&x| f64::from(x).exp()).sum::<f64>() / 4.0;
        assert_eq!(counts.frames, 2);
        assert!((counts.ln_mean_power()[0] - power.ln()).abs() < 3e-3, "{gain}");
    }
}

#[test]
fn a_scan_that_is_silent_throughout_is_kept() {
    let mut counts = Counts::new(1, 1);
    counts.add(&[-32.2; 7]);
    assert_eq!(counts.frames, 7);
    assert_eq!(Counts::new(1, 1).frames, 0);
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
