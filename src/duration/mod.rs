//! How long a scan must last: T*, the minimum time between independent samples.
//!
//! The paper's Algorithm 1: for a lag t, R times, draw a start t₁ and pair the samples of all Q
//! trials at t₁ with those at t₁ + t; T* is the first t at which the upper bound CB+ of HSIC lies
//! below the mean threshold κ. [`Trials`] checks the recordings, [`Search`] computes the curve and
//! finds T*, [`ScanNeed`] turns it into seconds to drag, [`report()`] does so for a library,
//! [`figure()`] draws it, and [`OnlineDuration`] estimates it from the one stream of a live scan.
//!
//! # What T* is worth
//! No dependence was *seen* at T*; with few trials little is seen. Say Q beside T*, and do not call
//! samples T* apart independent because 10 trials say so. T* is asked of sources of domain `time`:
//! bins of a spectrum and pixels of an image have none. What differs between trials for good (their
//! level, their loudness, the hand) stays dependent at every lag, and is answered "not within the
//! range", as is a periodic signal: beyond the lag that Algorithm 1 stops at, larger lags are looked
//! at too, and T* is withdrawn where the lower bound of the mean exceeds κ again.
//!
//! # Threshold
//! By permutations, as in the paper, or from a Pearson III (shifted gamma) distribution with the
//! exact mean, variance and skewness of the permutation distribution, see [`crate::kernel`]. Against
//! 20,000 permutations, on data sets with and without dependence, ties and heavy tails
//! (`cargo test --release --test duration -- --nocapture`), it is off by 1.1 % in the median and
//! 7.4 % at most at Q = 10 (54 data sets), 0.3 % and 1.5 % at Q = 20, 0.4 % and 1.4 % at Q = 50.
//!
//! # Processes of known correlation time
//! Autocorrelation exp(−t/τ), as AR(1) and a sampled Ornstein–Uhlenbeck process have; it falls to
//! 0.1 at 2.3 τ, and a T* below that "stops too early". 50 repetitions with fixed seeds, R = 200
//! (100 for Q > 50), κ by moments, t₁,max = 20,000; the sine has a period of 210 samples and phases
//! at random. T* in samples. `cargo run --release --example duration_study` prints
//!
//! | process | Q | rule | T* = 1 sample | no T* |
//! |---|---|---|---|---|
//! | noise | 10 | quantile | 48 % | 0 % |
//! | noise | 10 | mean-ci | 100 % | 0 % |
//! | noise | 30 | quantile | 70 % | 0 % |
//! | noise | 30 | mean-ci | 100 % | 0 % |
//! | sine | 10 | quantile | 0 % | 100 % |
//! | sine | 10 | mean-ci | 0 % | 100 % |
//! | sine | 30 | quantile | 0 % | 100 % |
//! | sine | 30 | mean-ci | 0 % | 100 % |
//!
//! | process | Q | rule | T* median (5–95 %) | stops too early | no T* |
//! |---|---|---|---|---|---|
//! | AR(1), τ = 20 | 10 | quantile | 33 (25–42) | 100 % | 0 % |
//! | AR(1), τ = 20 | 10 | mean-ci | 8 (7–9) | 100 % | 0 % |
//! | AR(1), τ = 20 | 30 | quantile | 40 (34–46) | 96 % | 0 % |
//! | AR(1), τ = 20 | 30 | mean-ci | 16 (15–17) | 100 % | 0 % |
//! | AR(1), τ = 20 | 100 | quantile | 46 (40–53) | 52 % | 0 % |
//! | AR(1), τ = 20 | 100 | mean-ci | 27 (26–29) | 100 % | 0 % |
//! | AR(1), τ = 100 | 10 | quantile | 133 (117–164) | 100 % | 0 % |
//! | AR(1), τ = 100 | 10 | mean-ci | 36 (34–42) | 100 % | 0 % |
//! | AR(1), τ = 100 | 20 | quantile | 165 (131–190) | 100 % | 0 % |
//! | AR(1), τ = 100 | 20 | mean-ci | 62 (57–67) | 100 % | 0 % |
//! | AR(1), τ = 100 | 30 | quantile | 177 (153–207) | 100 % | 0 % |
//! | AR(1), τ = 100 | 30 | mean-ci | 78 (73–83) | 100 % | 0 % |
//! | AR(1), τ = 100 | 50 | quantile | 202 (179–228) | 96 % | 0 % |
//! | AR(1), τ = 100 | 50 | mean-ci | 100 (95–105) | 100 % | 0 % |
//!
//! So `mean-ci` is the default: on noise it answers 1 sample, and it varies little from one set of
//! trials to the next, and grows with Q as the test's power does. `quantile` compares two estimates
//! of one quantile: where nothing depends on anything it stops when chance lets it, after one sample
//! in half of the runs and much later in others, and it does not stop at all where HSIC scatters
//! more than κ, as below. It is nearer to 2.3 τ because of that scatter, not because it sees more.
//! Either rule stops too early with few trials: at Q = 10 `mean-ci` answers about 0.4 τ, a sixth of
//! the time at which the autocorrelation has fallen to 0.1.
//!
//! # Real dragging sounds
//! The sounds of LMT108 that could be had (20 surfaces × 10 trials, one person, 44.1 kHz), taken as
//! series in time; R = 500, 100 permutations, lags to 125 ms, T* in samples.
//! `cargo run --release --example duration_study -- LMT_108_SurfaceMaterials_Database` prints
//!
//! | surface | Q | quantile | mean-ci | HSIC/κ at 1 s/8 |
//! |---|---|---|---|---|
//! | G1RhombAluminumMesh | 10 | 3759 (85.24 ms) | 40 (0.91 ms) | 0.63 |
//! | G1SquaredAluminumMesh | 10 | 3773 (85.56 ms) | 34 (0.77 ms) | 0.63 |
//! | G2GraniteTypeVeneziano | 10 | 1923 (43.61 ms) | 22 (0.50 ms) | 0.63 |
//! | G2StoneTileVersion1 | 10 | 2914 (66.08 ms) | 5 (0.11 ms) | 0.61 |
//! | G2StoneTileVersion2 | 10 | 2710 (61.45 ms) | 7 (0.16 ms) | 0.61 |
//! | G3AluminumPlate | 10 | 816 (18.50 ms) | 2 (0.05 ms) | 0.60 |
//! | G3CeramicPlate | 10 | 2387 (54.13 ms) | 4 (0.09 ms) | 0.63 |
//! | G4Bamboo | 10 | not within 125 ms | 264 (5.99 ms) | 0.73 |
//! | G4CherryTree | 10 | 234 (5.31 ms) | 9 (0.20 ms) | 0.60 |
//! | G4LaminatedWood | 10 | 3131 (71.00 ms) | 8 (0.18 ms) | 0.62 |
//! | G5SolidRubberPlateVersion1 | 10 | 2100 (47.62 ms) | 24 (0.54 ms) | 0.61 |
//! | G5SolidRubberPlateVersion2 | 10 | 1400 (31.75 ms) | 18 (0.41 ms) | 0.60 |
//! | G6Carpet | 10 | 3968 (89.98 ms) | 8 (0.18 ms) | 0.61 |
//! | G6Fibers | 10 | 1784 (40.45 ms) | 20 (0.45 ms) | 0.64 |
//! | G7FineFoamVersion1 | 10 | 3720 (84.35 ms) | 3 (0.07 ms) | 0.61 |
//! | G7FineFoamVersion2 | 10 | 5511 (124.97 ms) | 3 (0.07 ms) | 0.64 |
//! | G8CardboardVersion2 | 10 | 5333 (120.93 ms) | 10 (0.23 ms) | 0.66 |
//! | G8RoughPaper | 10 | not within 125 ms | 12 (0.27 ms) | 0.64 |
//! | G8WallpaperVersion2 | 10 | 1595 (36.17 ms) | 16 (0.36 ms) | 0.60 |
//! | G9FloorClothVersion2 | 10 | not within 125 ms | 4 (0.09 ms) | 0.70 |
//!
//! Q = 10 limits all of it: differences between surfaces are large against the spread above, but
//! each T* is too short rather than too long. The last column, mean HSIC over mean κ at the largest
//! lag, is what it is for independent samples of this kind (0.6); where it is larger, the trials
//! differ in something that lasts. G4Bamboo is such a one: its HSIC hovers about κ, and whether it has
//! a T* depends on the draws.
//!
//! # Speed
//! The work of the paper's Fig. 7 (R = 500, 1000 lags, Q = 10: 500,000 tests), one core of a machine
//! that others were using: 0.9 s with 100 permutations, 0.5 s by moments; the online form at 10 kHz
//! takes 0.8 % of a core, and 4 to 19 ms each half second. `cargo run --release --example
//! duration_bench` prints these.

mod batch;
mod estimate;
mod figure;
mod lanes;
mod need;
mod online;
mod report;
mod search;
pub mod simulate;
mod trials;
mod wild;

pub use estimate::{CurvePoint, Estimate, Outcome, Rule, Settings};
pub use figure::figure;
pub use need::{SAMPLES, START_S, ScanNeed, Second};
pub use online::{OnlineDuration, OnlineError, OnlineEstimate, OnlineSettings};
pub use report::{DurationReport, Question, ReportError, SceneDuration, SourceDuration, report};
pub use search::{Search, t_star};
pub use trials::{DurationError, FEWEST_FRAMES, Trials};
