//! Times the paper's Fig. 7 workload and the online form, on one core.
//!
//!     cargo run --release --example duration_bench

use std::time::Instant;

use surfaced::duration::{Rule, Search, Settings, Trials, simulate};
use surfaced::kernel::Threshold;
use surfaced::seed;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut rng = seed::rng(1, &[b"bench"]);
    let make = || simulate::ar1(48_000, 100.0, &mut rng);
    let trials = Trials::new(simulate::trials(10, 1e4, make)?)?;
    println!("Fig. 7 work: R = 500, 1000 lags, Q = 10, one source, one surface, one core");
    for (name, threshold) in
        [("100 permutations", Threshold::Permutations(100)), ("gamma", Threshold::Gamma)]
    {
        let settings = Settings { threshold, rule: Rule::MeanCi, ..Settings::default() };
        let mut search = Search::new(&trials, settings)?;
        let start = Instant::now();
        let kappa: f64 = (1..=1000).map(|lag| search.at(lag).kappa).sum();
        let seconds = start.elapsed().as_secs_f64();
        println!(
            "  {name:17} {seconds:6.3} s, {:5.2} µs a test (mean κ {:.5})",
            seconds * 1e6 / 500_000.0,
            kappa / 1000.0
        );
    }
    Ok(())
}
