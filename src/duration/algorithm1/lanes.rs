//! Eight f64 side by side: the arithmetic that the batches of tests are made of.

/// Number of lanes: one AVX-512 register, two AVX2 registers.
pub(super) const LANES: usize = 8;
/// One number for each of eight tests.
pub(super) type F64Lanes = [f64; LANES];

/// `f` of each pair of lanes.
#[inline(always)]
pub(super) fn map2(a: F64Lanes, b: F64Lanes, f: impl Fn(f64, f64) -> f64) -> F64Lanes {
    let mut out = [0.0; LANES];
    for lane in 0..LANES {
        out[lane] = f(a[lane], b[lane]);
    }
    out
}

/// 1/k! for k = 0 to 13.
const INVERSE_FACTORIALS: [f64; 14] = {
    let (mut table, mut factorial, mut k) = ([1.0; 14], 1.0, 1);
    while k < 14 {
        factorial *= k as f64;
        table[k] = 1.0 / factorial;
        k += 1;
    }
    table
};

/// exp(x) for x ≤ 0, relative error below 1e-15 (a test) down to x = −700; below that, e^−700.
///
/// Range reduction to |r| ≤ ln 2/2 by the usual two-part ln 2, then the Taylor polynomial of degree
/// 13, whose remainder is below 1e-17 there.
#[inline(always)]
pub(super) fn exp_of_nonpositive(x: F64Lanes) -> F64Lanes {
    /// 1.5·2⁵²: adding it rounds to a whole number, which is then in the low bits.
    const ROUND: f64 = 6_755_399_441_055_744.0;
    const LN2_HIGH: f64 = 6.931_471_803_691_238e-1;
    const LN2_LOW: f64 = 1.908_214_929_270_587_7e-10;
    let mut out = [0.0; LANES];
    for lane in 0..LANES {
        let x = if x[lane] > -700.0 { x[lane] } else { -700.0 };
        let shifted = x * std::f64::consts::LOG2_E + ROUND;
        let n = shifted - ROUND;
        let r = (x - n * LN2_HIGH) - n * LN2_LOW;
        let mut p = INVERSE_FACTORIALS[13];
        for k in (0..13).rev() {
            p = p * r + INVERSE_FACTORIALS[k];
        }
        let exponent = shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(1023);
        out[lane] = p * f64::from_bits(exponent << 52);
    }
    out
}

/// Comparators of a network that sorts `count` numbers: Batcher's odd–even merge exchange (D. E.
/// Knuth, The Art of Computer Programming 3, 1998, section 5.2.2, algorithm M).
pub(super) fn sorting_network(count: usize) -> Vec<(u32, u32)> {
    let mut network = Vec::new();
    if count < 2 {
        return network;
    }
    let top = count.next_power_of_two() / 2;
    let mut p = top;
    while p > 0 {
        let (mut q, mut r, mut d) = (top, 0, p);
        loop {
            for i in 0..count - d {
                if i & p == r {
                    network.push((i as u32, (i + d) as u32));
                }
            }
            if q == p {
                break;
            }
            d = q - p;
            q /= 2;
            r = p;
        }
        p /= 2;
    }
    network
}

/// Sorts each lane upwards by the network. No value may be NaN.
#[inline(always)]
pub(super) fn sort_lanes(values: &mut [F64Lanes], network: &[(u32, u32)]) {
    for &(low, high) in network {
        let (a, b) = (values[low as usize], values[high as usize]);
        // Not `if x < y`: of that the compiler makes masked stores, which are three times slower.
        values[low as usize] = map2(a, b, f64::min);
        values[high as usize] = map2(a, b, f64::max);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_exact_to_1e_15() {
        for i in 0..70_000 {
            let x = -f64::from(i) / 100.0;
            let got = exp_of_nonpositive([x; LANES])[0];
            assert!((got / x.exp() - 1.0).abs() < 1e-15, "{x}");
        }
        assert!(exp_of_nonpositive([f64::NEG_INFINITY; LANES])[0] < 1e-300);
    }

    #[test]
    fn the_network_sorts_any_number_of_values() {
        for count in [1, 2, 3, 7, 45, 64, 190] {
            let network = sorting_network(count);
            let mut values: Vec<F64Lanes> =
                (0..count).map(|i| [((i * 7919 + 13) % 101) as f64; LANES]).collect();
            let mut want: Vec<f64> = values.iter().map(|v| v[0]).collect();
            want.sort_unstable_by(f64::total_cmp);
            sort_lanes(&mut values, &network);
            assert!(values.iter().zip(&want).all(|(v, &w)| v[3] == w), "{count}");
        }
    }
}
