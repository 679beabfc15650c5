//! T* of processes whose correlation time is known: by the published rule, and pooled.

use crate::common::simulate;
use surfaced::independence::{
    Algorithm1Settings, CORRELATION, DurationError, Estimate, PooledAnswer, Rule, Search, Trials,
    VALUES, at_needed_rate,
};
use surfaced::kernel::Threshold;
use surfaced::seed;
use surfaced::trial::Series;

fn trials(
    count: usize,
    seed: u64,
    make: impl Fn(&mut rand_chacha::ChaCha8Rng) -> Vec<f32>,
) -> Trials {
    let mut rng = seed::rng(seed, &[b"search"]);
    Trials::new(simulate::trials(count, 1e4, || make(&mut rng)).unwrap()).unwrap()
}

fn t_star(trials: &Trials, settings: Algorithm1Settings) -> Result<Estimate, DurationError> {
    Ok(Search::new(trials, settings)?.find(settings.rule))
}

fn gamma(draws: usize) -> Algorithm1Settings {
    Algorithm1Settings { draws, threshold: Threshold::Gamma, ..Algorithm1Settings::default() }
}

#[test]
fn coarse_to_fine_finds_what_the_plain_search_finds() {
    for (seed, tau) in [(1, 0.0), (2, 5.0), (3, 20.0), (4, 60.0), (5, 60.0), (6, 150.0)] {
        let trials = trials(10, seed, |rng| simulate::ar1(24_000, tau, rng));
        for (rule, look_beyond) in [(Rule::Quantile, false), (Rule::MeanCi, true)] {
            let [coarse, plain] = [false, true].map(|exhaustive| {
                let settings = Algorithm1Settings { exhaustive, look_beyond, ..gamma(100) };
                Search::new(&trials, settings).unwrap().find(rule).outcome
            });
            assert_eq!(coarse, plain, "τ = {tau}, {rule}");
        }
    }
}

#[test]
fn by_mean_ci_noise_is_independent_at_the_first_lag() {
    let at_once = (0..40)
        .filter(|&seed| {
            let trials = trials(10, seed, |rng| simulate::ar1(3000, 0.0, rng));
            let settings = Algorithm1Settings { latest_start: 2000, ..gamma(100) };
            t_star(&trials, settings).unwrap().t_star() == Some(1)
        })
        .count();
    assert!(at_once >= 36, "{at_once} of 40");
}

#[test]
fn a_sine_has_no_t_star() {
    for (seed, period) in [(1, 40.0), (2, 210.0), (3, 900.0)] {
        for rule in [Rule::Quantile, Rule::MeanCi] {
            let trials = trials(10, seed, |rng| simulate::sine(30_000, period, rng));
            let estimate = Search::new(&trials, gamma(200)).unwrap().find(rule);
            assert_eq!(estimate.t_star(), None, "period {period}, {rule}");
        }
    }
}

#[test]
fn more_trials_see_weaker_dependence() {
    let at = |count| {
        let trials = trials(count, 9, |rng| simulate::ar1(22_000, 20.0, rng));
        let settings = Algorithm1Settings { latest_start: 20_000, ..gamma(200) };
        t_star(&trials, settings).unwrap().t_star().unwrap()
    };
    let (few, many) = (at(10), at(40));
    assert!((4..20).contains(&few) && (15..60).contains(&many), "{few} {many}");
}

#[test]
fn the_latest_start_shrinks_to_what_the_trials_allow() {
    let trials = trials(10, 3, |rng| simulate::ar1(5000, 3.0, rng));
    let estimate = t_star(&trials, gamma(50)).unwrap();
    assert_eq!(estimate.latest_start, 4000);
}

#[test]
fn impossible_settings_are_refused() {
    let trials = trials(10, 3, |rng| simulate::ar1(5000, 3.0, rng));
    for settings in [
        Algorithm1Settings { alpha: 0.0, ..gamma(50) },
        Algorithm1Settings { draws: 3, ..gamma(50) },
        Algorithm1Settings { largest_lag: 0, ..gamma(50) },
        Algorithm1Settings { threshold: Threshold::Permutations(5), ..gamma(50) },
    ] {
        assert!(t_star(&trials, settings).is_err());
    }
}

fn ar1(tau: f64, count: usize, frames: usize, seed: u64) -> Vec<Series> {
    let mut rng = seed::rng(seed, &[b"pooled"]);
    simulate::trials(count, 1e4, || simulate::ar1(frames, tau, &mut rng)).unwrap()
}

#[test]
fn t_star_is_where_the_autocorrelation_has_fallen_to_a_tenth() {
    for (tau, count, frames) in [(5.0, 10, 12_000), (20.0, 10, 24_000), (20.0, 1, 48_000)] {
        let series = ar1(tau, count, frames, 1);
        let got = at_needed_rate(&series, frames, CORRELATION, VALUES).unwrap();
        let (t_star, upper) = (got.t_star_samples().unwrap(), got.upper_samples().unwrap());
        let in_tau = t_star as f64 / tau;
        assert!((2.0..2.8).contains(&in_tau) && upper >= t_star, "{tau}: {in_tau} {upper}");
        let inflation = got.inflation.unwrap() / (2.0 * tau);
        assert!((0.85..1.15).contains(&inflation), "{inflation}");
    }
}

#[test]
fn a_larger_dependence_is_reached_sooner() {
    let series = ar1(50.0, 10, 12_000, 2);
    let at = |correlation| {
        at_needed_rate(&series, 12_000, correlation, VALUES).unwrap().t_star_samples().unwrap()
    };
    let (half, tenth) = (at(0.5) as f64, at(0.1) as f64);
    assert!((half / 50.0 - 0.69).abs() < 0.15 && tenth > 2.0 * half, "{half} {tenth}");
}

#[test]
fn long_recordings_are_thinned_until_t_star_is_coarse_and_no_further() {
    for (tau, steps) in [(300.0, 18..=18), (20.0, 1..=3), (0.0, 1..=1)] {
        let series = ar1(tau, 6, 60_000, 3);
        let got = at_needed_rate(&series, 60_000, CORRELATION, 20_000).unwrap();
        assert!(steps.contains(&got.step), "{}", got.step);
        let t_star = got.t_star_samples().unwrap() as f64;
        assert!((t_star - f64::max(1.0, 2.3 * tau)).abs() <= 0.4 * tau, "{tau}: {t_star}");
    }
}

#[test]
fn noise_is_independent_at_once_a_sine_never_and_little_data_say_nothing() {
    let mut rng = seed::rng(4, &[b"pooled"]);
    let noise = ar1(0.0, 5, 4000, 4);
    let got = |series: &[Series], frames| {
        at_needed_rate(series, frames, CORRELATION, VALUES).unwrap().answer
    };
    assert_eq!(got(&noise, 4000), PooledAnswer::Found { t_star: 1.0, upper: 1.0 });
    let sines = simulate::trials(5, 1e4, || simulate::sine(4000, 210.0, &mut rng)).unwrap();
    assert_eq!(got(&sines, 4000), PooledAnswer::Never);
    let slow = ar1(300.0, 3, 4000, 5);
    assert!(matches!(got(&slow, 4000), PooledAnswer::TooLittleData { more_trials: 1.. }));
}

#[test]
fn two_channels_depend_on_each_other_though_neither_on_itself() {
    let mut rng = seed::rng(5, &[b"pooled"]);
    let make = || {
        let x = simulate::ar1(6000, 0.0, &mut rng);
        let y = simulate::ar1(6000, 0.0, &mut rng);
        (0..6000).flat_map(|i| [x[i], if i < 5 { y[i] } else { x[i - 5] + y[i] }]).collect()
    };
    let series: Vec<Series> = std::iter::repeat_with(make)
        .take(8)
        .map(|samples| Series::new(1e4, 2, samples).unwrap())
        .collect();
    let got = at_needed_rate(&series, 6000, CORRELATION, VALUES).unwrap();
    assert_eq!(got.t_star_samples(), Some(6));
}

#[test]
fn a_constant_source_has_no_answer() {
    let flat = vec![Series::new(1e4, 1, vec![2.0; 500]).unwrap(); 6];
    assert_eq!(at_needed_rate(&flat, 500, CORRELATION, VALUES), None);
}
