//! Speed of method `reference`: `cargo bench --bench reference [-- kernel sums query halving cache]`.
//!
//! Prints these times on synthetic sample sets: a kernel evaluation for 1 to 4 channels; a score by
//! each way of summing, and in f64; a whole query against 1080 trials × 8 sources × R = 10, exact
//! and with halving (which drops poor candidates early); loading a library of 1080 prepared trials.
//! Also prints how often halving gives the same label over 500 queries. Each time is the least and
//! the median of several runs; on a shared machine, the processor time says more (Linux only).
//!
//! `SURFACED_BENCH_CACHE=FOLDER` keeps the prepared library in FOLDER; `SURFACED_BENCH_QUERIES=N`
//! compares labels in N queries instead of 500.

use std::collections::BTreeSet;
use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

use ndarray::Array2;
use surfaced::dataset::synth::{self, Parameters};
use surfaced::kernel::Points;
use surfaced::library::{Entry, LibraryError, LoadTrial, Outlines};
use surfaced::recognise::{
    QuerySet, Reference, ReferenceOptions, STAGES, SampleSet, Scratch, SumPrecision,
    prepare_library,
};
use surfaced::scene::{Scene, SourceId};
use surfaced::trial::{EXPERT, Trial};

const SURFACES: usize = 108;
const TRIALS: u32 = 10;
/// Number of queries over which labels are compared, at most.
const QUERIES: usize = 500;

fn main() {
    let asked: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let wants = |what: &str| asked.is_empty() || asked.iter().any(|a| a == what);
    if wants("kernel") {
        kernel();
    }
    if wants("sums") {
        sums();
    }
    if ["query", "halving", "cache"].iter().any(|what| wants(what)) {
        library(wants("query"), wants("halving"), wants("cache"));
    }
}

/// Least and median time of `runs` runs, in seconds.
fn timed(runs: usize, mut work: impl FnMut()) -> (f64, f64) {
    let mut times: Vec<f64> = (0..runs)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64()
        })
        .collect();
    times.sort_by(f64::total_cmp);
    (times[0], times[runs / 2])
}

/// Processor time that this process has used so far, in seconds, to 10 ms.
fn processor_s() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name in brackets may hold any text; fields 12 and 13 after it are utime and stime.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / 100.0)
}

fn kernel() {
    println!("ns an evaluation, 400 × 400 samples, one core: least (median) of 400 runs");
    println!(
        "{:>3}  {:<18} {:<18} {:<18}",
        "ch", "with others", "with far outliers", "with itself"
    );
    for channels in 1..=4 {
        // Values spread like a normal distribution; with a large `far`, one value lies far away.
        let fill = |key: usize, far: f64| {
            let mut points = Points::<f32>::default();
            points.fill(channels, 1.0, |c| {
                (0..400).map(move |i| {
                    let at = (i * (7 + c) + key) as f64 * 0.618_033_988_749;
                    let x: f64 = (1..=4).map(|k| (at * f64::from(k)).fract() - 0.5).sum();
                    if i == 17 { x * far } else { 1.7 * x }
                })
            });
            points
        };
        let (a, b, far) = (fill(1, 1.7), fill(2, 1.7), fill(3, 1e4));
        let cross = |b: &Points<f32>| {
            timed(400, || {
                black_box(black_box(&a).sum(black_box(b)));
            })
        };
        let itself = timed(400, || {
            black_box(black_box(&a).self_sum());
        });
        let show =
            |(least, median): (f64, f64)| format!("{:.3} ({:.3})", least / 160e-6, median / 160e-6);
        println!(
            "{channels:>3}  {:<18} {:<18} {:<18}",
            show(cross(&b)),
            show(cross(&far)),
            show(itself)
        );
    }
}

/// Times a score of 400 by 400 samples, summed as [`QuerySet`] chooses, and in f64.
fn sums() {
    println!("\nµs a score, 400 × 400 samples, one core: least (median) of 400 runs");
    println!("{:<34} {:<18} {:<18}", "", "fast", "f64");
    let samples = |channels: usize, values: Option<usize>, key: usize| {
        Array2::from_shape_fn((400, channels), |(i, c)| {
            let at = (i * (7 + c) + key) as f64 * 0.618_033_988_749;
            let x = (1..=4).map(|k| (at * f64::from(k)).fract() - 0.5).sum::<f64>();
            values.map_or(x, |n| (x * n as f64 / 4.0).round())
        })
    };
    for (name, channels, values) in [
        ("few distinct: by counts", 1, Some(4)),
        ("one channel: on a line", 1, None),
        ("two channels: over lanes", 2, None),
        ("three channels: over lanes", 3, None),
        ("four channels: over lanes", 4, None),
    ] {
        let z = SampleSet::new(&samples(channels, values, 1), None);
        let mut y = SampleSet::new(&samples(channels, values, 2).mapv(|x| 1.5 * x), None);
        y.tabulate();
        let time = |precision| {
            let (query, mut scratch) = (QuerySet::new(&z, true, precision), Scratch::default());
            let (least, median) = timed(400, || {
                black_box(query.score(black_box(&y), &mut scratch));
            });
            format!("{:.2} ({:.2})", least * 1e6, median * 1e6)
        };
        println!("{name:<34} {:<18} {:<18}", time(SumPrecision::Fast), time(SumPrecision::Oracle));
    }
}

/// A generated trial with a stamp, as if it lay in files, so that the cache accepts it.
#[derive(Debug)]
struct Stamped(Entry);

impl LoadTrial for Stamped {
    fn load(&self, _: &[SourceId]) -> Result<Trial, LibraryError> {
        self.0.load()
    }

    fn outlines(&self, _: &[SourceId]) -> Result<Outlines, LibraryError> {
        self.0.outlines()
    }

    fn stamp(&self, _: &[SourceId]) -> Option<u64> {
        Some(1)
    }
}

fn library(query: bool, halving: bool, cache: bool) {
    let users = QUERIES.div_ceil(SURFACES) as u32;
    let parameters =
        Parameters { surfaces: SURFACES as _, trials: TRIALS, users, ..Parameters::default() };
    let scene = Scene::lmt108();
    let made = synth::library(&parameters);
    let (of_expert, of_users): (Vec<Entry>, Vec<Entry>) =
        made.entries.into_iter().partition(|entry| entry.key.user == EXPERT);
    let entries: Vec<Entry> = of_expert
        .into_iter()
        .map(|e| Entry::new(e.key.clone(), e.sources.clone(), Arc::new(Stamped(e))))
        .collect();
    let exact = Reference::new(scene.clone(), ReferenceOptions::default());
    let halved = Reference::new(
        scene,
        ReferenceOptions { halving: STAGES.to_vec(), ..ReferenceOptions::default() },
    );

    let folder = std::env::temp_dir().join(format!("surfaced-bench-{}", std::process::id()));
    let kept = std::env::var_os("SURFACED_BENCH_CACHE").map(std::path::PathBuf::from);
    let folder = kept.clone().unwrap_or(folder);
    if let Err(error) = std::fs::create_dir_all(&folder) {
        eprintln!("{}: {error}", folder.display());
        return;
    }
    let wanted: BTreeSet<usize> = (0..entries.len()).collect();
    let prepare = || {
        let progress = |done: usize, of: usize| {
            if done.is_multiple_of(100) {
                eprint!("\rpreparing {done} of {of}  ");
            }
        };
        prepare_library(&exact, &entries, &wanted, Some(&folder), &progress)
            .unwrap_or_else(|error| panic!("{error}"))
    };
    let start = Instant::now();
    let mut prepared = prepare();
    eprintln!();
    println!(
        "\npreparing {} trials, generating them included: {:.1} s ({} from the cache)",
        entries.len(),
        start.elapsed().as_secs_f64(),
        prepared.from_cache
    );
    if cache {
        let (least, median) = timed(5, || prepared = prepare());
        eprintln!();
        let size = folder.join(".reference.surfaced-cache").metadata().map_or(0, |m| m.len());
        println!(
            "loading them prepared: {least:.2} s (median {median:.2} s), {} of them from a file of \
             {} MB {}",
            prepared.from_cache,
            size >> 20,
            prepared.remarks.join("; ")
        );
    }
    let fit = |method| prepared.fit(method, &wanted).unwrap_or_else(|error| panic!("{error}"));
    let (exact, halved) = (fit(&exact), fit(&halved));
    if query {
        let entry = &of_users[0];
        let trial = entry.load().unwrap_or_else(|error| panic!("{error}"));
        let ready = || exact.prepare(entry, &trial).unwrap_or_else(|error| panic!("{error}"));
        let (least, median) = timed(9, || drop(black_box(ready())));
        println!("preparing one query: {:.1} ms (median {:.1} ms)", least * 1e3, median * 1e3);
        let z = ready();
        for (name, model) in [("exact", &exact), ("halving", &halved)] {
            let before = processor_s();
            let (least, median) = timed(9, || drop(black_box(model.rank(&z))));
            let used = processor_s().zip(before).map(|(after, before)| (after - before) / 9.0);
            println!(
                "one query, 1080 trials × 8 sources × R = 10, {name}: {least:.3} s (median \
                 {median:.3} s), {:.3} s of processor time",
                used.unwrap_or(f64::NAN)
            );
        }
    }
    if halving {
        let (mut same, mut right, mut all) = (0, [0, 0], 0);
        let said = std::env::var("SURFACED_BENCH_QUERIES").ok().and_then(|n| n.parse().ok());
        let queries = said.unwrap_or(QUERIES).min(QUERIES);
        // Takes queries from all surfaces and users, however few are compared.
        for i in 0..queries {
            let entry = &of_users[i * of_users.len() / queries];
            let trial = entry.load().unwrap_or_else(|error| panic!("{error}"));
            let z = exact.prepare(entry, &trial).unwrap_or_else(|error| panic!("{error}"));
            let answers = [&exact, &halved].map(|model| {
                model.rank(&z).unwrap_or_else(|error| panic!("{error}")).surface().to_string()
            });
            same += usize::from(answers[0] == answers[1]);
            for (right, answer) in right.iter_mut().zip(&answers) {
                *right += usize::from(*answer == entry.key.surface);
            }
            all += 1;
            if all % 50 == 0 {
                eprintln!("compared {all} of {queries}");
            }
        }
        println!(
            "halving: the same label in {same} of {all} queries; right: exact {}, halving {}",
            right[0], right[1]
        );
    }
    if kept.is_none()
        && let Err(error) = std::fs::remove_dir_all(&folder)
    {
        eprintln!("{}: {error}", folder.display());
    }
}
