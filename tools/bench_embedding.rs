//! Speed of the method `embedding`: `cargo bench --bench embedding`.
//!
//! Trains on a synthetic library of 1080 trials × 8 sources, and names one trial of each of 60
//! surfaces. Series arrive in pieces of 20 ms and are transformed as they do, pictures when they are
//! taken, as while a scan goes on. What is timed begins when the last piece is at hand: its frames,
//! what has gathered so far, and the ranking of all 108 surfaces. Beside it, the time from raw
//! samples of the whole scan to the answer, as `surfaced eval` counts it. Medians and 99th
//! percentiles are printed, nothing is judged; on a machine that is shared with others, the processor
//! time of a ranking says more (Linux only).
//!
//! `SURFACED_BENCH_SURFACES=N` takes a library of N surfaces instead of 108.

use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

use surfaced::dataset::synth::{self, Parameters};
use surfaced::library::Entry;
use surfaced::recognise::{
    Embedding, EmbeddingModel, EmbeddingOptions, FrameFeatures, FrameStream, Model, Prepared,
};
use surfaced::scene::{Scene, SourceId};
use surfaced::trial::{EXPERT, Series, Signal, Trial};

const SURFACES: usize = 108;
const TRIALS: u32 = 10;
const QUERIES: usize = 60;
/// Duration of a piece, in seconds.
const PIECE_S: f64 = 0.02;
/// Times that each query is named.
const RUNS: usize = 5;

fn main() {
    let said = std::env::var("SURFACED_BENCH_SURFACES").ok().and_then(|n| n.parse().ok());
    let surfaces: usize = said.unwrap_or(SURFACES);
    let parameters =
        Parameters { surfaces: surfaces as _, trials: TRIALS, users: 1, ..Parameters::default() };
    let scene = Scene::lmt108();
    let made = synth::library(&parameters);
    let (library, queries): (Vec<Entry>, Vec<Entry>) =
        made.entries.into_iter().partition(|entry| entry.key.user == EXPERT);
    for discriminant in [true, false] {
        let options = EmbeddingOptions { discriminant, ..EmbeddingOptions::default() };
        let method = Embedding::new(scene.clone(), options);
        let start = Instant::now();
        let prepared: Vec<Arc<FrameFeatures>> =
            library.iter().map(|entry| Arc::new(prepare(&method, entry, &load(entry)))).collect();
        let frames_s = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let model = method.train(prepared).unwrap_or_else(|error| panic!("{error}"));
        let name = if discriminant { "with" } else { "without" };
        println!(
            "\nembedding {name} discriminant, {} trials × 8 sources: generated and transformed in \
             {frames_s:.1} s, trained in {:.1} s",
            library.len(),
            start.elapsed().as_secs_f64()
        );
        let mut times = Times::default();
        let mut right = 0;
        let asked: Vec<&Entry> = queries.iter().take(QUERIES).collect();
        for entry in &asked {
            let trial = load(entry);
            let mut answer = String::new();
            for _ in 0..RUNS {
                answer = name_once(&model, &scene, entry, &trial, &mut times);
            }
            right += usize::from(answer == entry.key.surface);
        }
        times.print();
        let ready =
            |entry: &&Entry| Prepared::Frames(Arc::new(prepare(&method, entry, &load(entry))));
        let ready: Vec<Prepared> = asked.iter().map(ready).collect();
        let before = processor_s();
        for query in (0..RUNS).flat_map(|_| &ready) {
            drop(black_box(model.rank(black_box(query))));
        }
        if let Some(used_s) = processor_s().zip(before).map(|(after, before)| after - before) {
            let each_ms = used_s * 1e3 / (RUNS * ready.len()) as f64;
            println!("ranking, processor time of all threads: {each_ms:.2} ms");
        }
        println!("right: {right} of {}", asked.len());
    }
}

/// Processor time of this process so far, in seconds, to 10 ms.
fn processor_s() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name in brackets may hold anything; utime and stime are the 12th and 13th after it.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / 100.0)
}

fn load(entry: &Entry) -> Trial {
    entry.load().unwrap_or_else(|error| panic!("{error}"))
}

fn prepare(method: &Embedding, entry: &Entry, trial: &Trial) -> FrameFeatures {
    method.frames(entry, trial).unwrap_or_else(|error| panic!("{error}"))
}

/// Milliseconds, one for each time that a query was named.
#[derive(Default)]
struct Times {
    /// Frames of the last piece.
    last_piece: Vec<f64>,
    /// What has gathered so far.
    gathering: Vec<f64>,
    ranking: Vec<f64>,
    /// The three together.
    after_scan: Vec<f64>,
    /// From raw samples of the whole scan to the answer.
    whole: Vec<f64>,
}

impl Times {
    fn print(&mut self) {
        for (what, times) in [
            ("frames of the last 20 ms", &mut self.last_piece),
            ("gathering", &mut self.gathering),
            ("ranking", &mut self.ranking),
            ("after the scan ends", &mut self.after_scan),
            ("from all raw samples", &mut self.whole),
        ] {
            times.sort_by(f64::total_cmp);
            let at = |share: f64| times[((times.len() - 1) as f64 * share) as usize];
            println!("{what:<26} median {:7.3} ms, p99 {:7.3} ms", at(0.5), at(0.99));
        }
    }
}

/// Names a trial both ways; the answers are the same.
fn name_once(
    model: &EmbeddingModel,
    scene: &Scene,
    entry: &Entry,
    trial: &Trial,
    times: &mut Times,
) -> String {
    let mut stream = FrameStream::new(scene.clone(), entry.key.clone());
    let mut last: Vec<(&SourceId, Signal)> = Vec::new();
    for (id, signal) in &trial.signals {
        let Signal::Series(series) = signal else {
            push(&mut stream, id, signal);
            continue;
        };
        let frames = (PIECE_S * series.rate_hz()) as usize * series.channels();
        let mut pieces: Vec<Signal> = (series.samples().chunks(frames))
            .map(|samples| {
                let piece = Series::new(series.rate_hz(), series.channels(), samples.to_vec());
                Signal::Series(piece.unwrap_or_else(|error| panic!("{error}")))
            })
            .collect();
        last.extend(pieces.pop().map(|piece| (id, piece)));
        pieces.iter().for_each(|piece| push(&mut stream, id, piece));
    }

    let lap = |since: Instant| since.elapsed().as_secs_f64() * 1e3;
    let start = Instant::now();
    last.iter().for_each(|(id, piece)| push(&mut stream, id, piece));
    times.last_piece.push(lap(start));
    let part = Instant::now();
    let query = black_box(Prepared::Frames(Arc::new(stream.so_far())));
    times.gathering.push(lap(part));
    let part = Instant::now();
    let ranking = model.rank(&query).unwrap_or_else(|error| panic!("{error}"));
    times.ranking.push(lap(part));
    times.after_scan.push(lap(start));

    let start = Instant::now();
    let again = model.prepare(entry, trial).and_then(|query| model.rank(&query));
    times.whole.push(lap(start));
    let again = again.unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(ranking.surface(), again.surface(), "in pieces and as a whole");
    ranking.surface().to_string()
}

fn push(stream: &mut FrameStream, id: &SourceId, signal: &Signal) {
    stream.push(id, signal).unwrap_or_else(|error| panic!("{error}"));
}
