use super::*;

fn mono(interleaved: &[f32], channels: usize, pick: Pick) -> (Vec<f32>, u64) {
    let mut mono = Vec::new();
    let broken = mix(interleaved, channels, |x| x, pick, &mut mono);
    (mono, broken)
}

#[test]
fn channels_are_averaged_or_one_is_picked() {
    let frames = [0.5_f32, -0.1, 0.2, 0.4, 0.0, -0.4];
    for (channels, expected) in [(1, 6), (2, 3), (3, 2), (4, 1), (6, 1)] {
        assert_eq!(mono(&frames, channels, Pick::Mean).0.len(), expected);
    }
    assert_eq!(mono(&frames, 3, Pick::Mean).0, [0.2, 0.0]);
    for (pick, expected) in [(0, [0.5, 0.4]), (1, [-0.1, 0.0]), (2, [0.2, -0.4])] {
        assert_eq!(mono(&frames, 3, Pick::One(pick)).0, expected);
    }
}

#[test]
fn what_is_no_number_becomes_silence_and_is_counted() {
    let frames = [f32::NAN, 0.5, f32::INFINITY];
    assert_eq!(mono(&frames, 1, Pick::Mean), (vec![0.0, 0.5, 0.0], 2));
}
