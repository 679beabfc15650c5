//! Measures the speed of the method `embedding`: `cargo bench --bench embedding`.
//!
//! Trains on a synthetic library of 1080 trials × 8 sources, and names one trial of each of 60
//! surfaces. Times two things: the way from the raw samples of the whole scan to the answer, as
//! `surfaced eval` counts it, and the ranking alone. Prints medians and 99th percentiles, without a
//! verdict. On a shared machine, the processor time of a ranking says more (Linux only).
//!
//! `SURFACED_BENCH_SURFACES=N` uses N surfaces instead of 108.

use std::hint::black_box;
use std::time::Instant;

use surfaced::dataset::synth::{self, Parameters};
use surfaced::library::Entry;
use surfaced::recognise::{Embedding, EmbeddingOptions, LibraryShape, Method, Prepared};
use surfaced::scene::Scene;
use surfaced::trial::{EXPERT, Trial};

const SURFACES: usize = 108;
const TRIALS: u32 = 10;
const QUERIES: usize = 60;
/// Number of times that each query is named.
const RUNS: usize = 5;

fn main() {
    let given = std::env::var("SURFACED_BENCH_SURFACES").ok().and_then(|n| n.parse().ok());
    let surfaces: usize = given.unwrap_or(SURFACES);
    let parameters =
        Parameters { surfaces: surfaces as _, trials: TRIALS, users: 1, ..Parameters::default() };
    let method = Embedding::new(Scene::lmt108(), EmbeddingOptions::default());
    let made = synth::library(&parameters);
    let (library, queries): (Vec<Entry>, Vec<Entry>) =
        made.entries.into_iter().partition(|entry| entry.key.user == EXPERT);
    let shape = ready(LibraryShape::of(&library.iter().collect::<Vec<_>>()));
    let start = Instant::now();
    let prepared: Vec<Prepared> =
        library.iter().map(|entry| ready(method.prepare(entry, &load(entry), &shape))).collect();
    let frames_s = start.elapsed().as_secs_f64();
    let start = Instant::now();
    let model = ready(method.fit(prepared, &shape.into()));
    println!(
        "{} trials × 8 sources: generated and transformed in {frames_s:.1} s, trained and \
         calibrated in {:.1} s",
        library.len(),
        start.elapsed().as_secs_f64()
    );
    let (mut whole, mut ranking) = (Vec::new(), Vec::new());
    let mut right = 0;
    let queries: Vec<&Entry> = queries.iter().take(QUERIES).collect();
    let mut prepared = Vec::new();
    for entry in &queries {
        let trial = load(entry);
        for _ in 0..RUNS {
            let start = Instant::now();
            let query = ready(model.prepare(entry, &trial));
            let part = Instant::now();
            let answer = ready(model.rank(&query));
            ranking.push(part.elapsed().as_secs_f64() * 1e3);
            whole.push(start.elapsed().as_secs_f64() * 1e3);
            right += usize::from(answer.surface() == entry.key.surface);
            prepared.push(query);
        }
    }
    print("from all raw samples", &mut whole);
    print("ranking", &mut ranking);
    let before = processor_s();
    for query in &prepared {
        drop(black_box(model.rank(black_box(query))));
    }
    if let Some(used_s) = processor_s().zip(before).map(|(after, before)| after - before) {
        let each_ms = used_s * 1e3 / prepared.len() as f64;
        println!("ranking, processor time of all threads: {each_ms:.2} ms");
    }
    println!("right: {right} of {}", RUNS * queries.len());
}

fn ready<T, E: std::fmt::Display>(result: Result<T, E>) -> T {
    result.unwrap_or_else(|error| panic!("{error}"))
}

fn load(entry: &Entry) -> Trial {
    ready(entry.load())
}

fn print(what: &str, times: &mut [f64]) {
    times.sort_by(f64::total_cmp);
    let at = |share: f64| times[((times.len() - 1) as f64 * share) as usize];
    println!("{what:<22} median {:7.3} ms, p99 {:7.3} ms", at(0.5), at(0.99));
}

/// Processor time that this process has used so far, in seconds, to 10 ms.
fn processor_s() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name in brackets may hold any text; fields 12 and 13 after it are utime and stime.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / 100.0)
}
