//! Times the rule `pooled` and its online form on one core, and the work of Fig. 7 on all cores.
//!
//!     cargo run --release --example duration_bench
//!
//! Needs optimisation level 3, as in the release profile: below it, the compiler does not vectorise
//! the code for lanes, and `pooled` takes several times as long.

#[path = "../tests/common/simulate.rs"]
mod simulate;

use rustix::time::{ClockId, clock_gettime};
use surfaced::independence::{
    Algorithm1Settings, CORRELATION, OnlineDuration, Rule, Search, Trials, VALUES, at_needed_rate,
};
use surfaced::kernel::Threshold;
use surfaced::seed;
use surfaced::trial::Series;

/// Processor time of this thread so far, in seconds; other programs on the machine do not count.
fn cpu_s() -> f64 {
    seconds(ClockId::ThreadCPUTime)
}

fn seconds(clock: ClockId) -> f64 {
    let now = clock_gettime(clock);
    now.tv_sec as f64 + 1e-9 * now.tv_nsec as f64
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    pooled()?;
    algorithm1()?;
    online()
}

/// Times rule `pooled` on one source of one surface: 10 trials of 4.8 s at 10 kHz.
fn pooled() -> Result<(), Box<dyn std::error::Error>> {
    println!("rule pooled, 10 × 48,000 frames, one core");
    for channels in 1..=3 {
        let mut rng = seed::rng(3, &[b"bench"]);
        let series: Vec<Series> = (0..10)
            .map(|_| {
                let stream = simulate::ar1(48_000 * channels, 100.0 * channels as f64, &mut rng);
                Series::new(1e4, channels, stream)
            })
            .collect::<Result<_, _>>()?;
        let start = cpu_s();
        let found = at_needed_rate(&series, 48_000, CORRELATION, VALUES);
        let seconds = cpu_s() - start;
        let t_star = found.and_then(|found| found.t_star_samples());
        println!("  {channels} channel(s)  {seconds:6.3} s (T* {t_star:?})");
    }
    Ok(())
}

fn algorithm1() -> Result<(), Box<dyn std::error::Error>> {
    let mut rng = seed::rng(1, &[b"bench"]);
    let make = || simulate::ar1(48_000, 100.0, &mut rng);
    let trials = Trials::new(simulate::trials(10, 1e4, make)?)?;
    println!("Fig. 7 work: R = 500, 1000 lags, Q = 10, one source, one surface, all cores");
    for (name, threshold) in
        [("100 permutations", Threshold::Permutations(100)), ("gamma", Threshold::Gamma)]
    {
        let settings =
            Algorithm1Settings { threshold, rule: Rule::MeanCi, ..Algorithm1Settings::default() };
        let mut search = Search::new(&trials, settings)?;
        let clocks = [ClockId::Monotonic, ClockId::ProcessCPUTime];
        let start = clocks.map(seconds);
        let kappa: f64 = (1..=1000).map(|lag| search.at(lag).kappa).sum();
        let [wall_s, cpu_s] = [0, 1].map(|at| seconds(clocks[at]) - start[at]);
        println!(
            "  {name:17} {wall_s:6.3} s, {:5.2} µs of processor time a test (mean κ {:.5})",
            cpu_s * 1e6 / 500_000.0,
            kappa / 1000.0
        );
    }
    Ok(())
}

/// Times the online form on 20 s of a stream, fed in blocks of 10 ms.
fn online() -> Result<(), Box<dyn std::error::Error>> {
    const SECONDS: usize = 20;
    println!("online form, 10 kHz, one estimate a second");
    for (channels, tau) in [(1, 20.0), (1, 200.0), (3, 200.0)] {
        let mut rng = seed::rng(2, &[b"bench"]);
        let stream = simulate::ar1(SECONDS * 10_000 * channels, tau * channels as f64, &mut rng);
        let mut online = OnlineDuration::new(1e4, channels);
        let (mut spent, mut slowest, mut last) = (0.0, 0.0f64, None);
        for block in stream.chunks(100 * channels) {
            let start = cpu_s();
            last = online.push(block)?.or(last);
            let seconds = cpu_s() - start;
            spent += seconds;
            slowest = slowest.max(seconds);
        }
        println!(
            "  {channels} channel(s), τ = {tau}: {:.2} % of a core, slowest block {:.1} ms, T* {:?}",
            100.0 * spent / SECONDS as f64,
            slowest * 1e3,
            last.and_then(|estimate| estimate.t_star_samples())
        );
    }
    Ok(())
}
