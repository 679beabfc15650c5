//! The part of `duration_study` on promises: does the accuracy hold that `surfaced duration`
//! promises for a scan time?

use std::collections::BTreeSet;
use std::path::Path;

use rand::seq::SliceRandom;
use surfaced::evaluate::{Evaluation, Run};
use surfaced::library::Entry;
use surfaced::recognise::{AccuracyAt, Goal, MethodName, MethodSpec, wilson_interval};
use surfaced::scene::Scene;
use surfaced::seed;

use super::Failure;

/// Number of splits of one person's trials into halves.
const SPLITS: u64 = 50;
const GOALS: [(&str, Goal); 4] = [
    ("1 point less than whole scans", Goal::Loss(0.01)),
    ("90 %", Goal::Accuracy(0.9)),
    ("95 %", Goal::Accuracy(0.95)),
    ("99 %", Goal::Accuracy(0.99)),
];

/// An accuracy promised from some trials, and the accuracy measured on other trials.
struct Checked {
    promised: AccuracyAt,
    /// Accuracy at that scan time on the trials that chose the time; it is too high.
    same_trials: f64,
    measured: (usize, usize),
    /// Counts of right answers and of queries, for scans of full length.
    whole: (usize, usize),
}

impl Checked {
    fn share((right, of): (usize, usize)) -> f64 {
        right as f64 / of.max(1) as f64
    }

    fn overlaps(&self) -> bool {
        let (low, high) = wilson_interval(self.measured.0, self.measured.1);
        low <= self.promised.accuracy_high && self.promised.accuracy_low <= high
    }
}

/// Checks the promises of `embedding`: for one person, half of the trials against the other half;
/// for several people, each person against the other people.
pub fn promises(folder: &Path) -> Result<(), Failure> {
    let library = surfaced::dataset::open(folder, &Scene::lmt108())?;
    let method = MethodSpec::from(MethodName::Embedding).build(&library.scene);
    // One fold of all trials, so that each trial is prepared only once.
    let all = surfaced::evaluate::Fold {
        name: "all".into(),
        library: (0..library.entries.len()).collect(),
        queries: Vec::new(),
    };
    let folds = [all];
    let run = Evaluation::new(&library.scene, &library.entries, &folds).prepare(&*method)?;
    let users: BTreeSet<&str> = library.entries.iter().map(|e| e.key.user.as_str()).collect();
    println!("\n{}: promised and measured by `embedding`\n", library.name);
    match users.len() {
        1 => halves(&run, &library.entries),
        _ => left_out_users(&run, &library.entries, &users),
    }
}

/// The promises of the trials `from` for each goal, and the accuracy measured on the trials `to`;
/// `None` for a goal without a promise.
fn check(
    run: &Run<'_, '_>,
    (from, to): (&[usize], &[usize]),
    goals: &[Goal],
) -> Result<Vec<Option<Checked>>, Failure> {
    let model = run.fit(from)?;
    let by_time =
        model.clone().embedding().ok_or("the method cannot follow scans")?.left_out_accuracy();
    let named = |seconds: Option<f64>| -> Result<(usize, usize), Failure> {
        let mut right = 0;
        for &i in to {
            let query = run.query(&model, i, seconds)?;
            // A scan that is too short to be named counts as named wrong.
            let surface = model.rank(&query.prepared).ok().map(|r| r.surface().to_string());
            right += usize::from(surface.as_deref() == Some(&*run.on.trials.key(i).surface));
        }
        Ok((right, to.len()))
    };
    let whole = named(None)?;
    goals
        .iter()
        .map(|&goal| {
            let Some(promised) = by_time.scan_time(goal).enough else { return Ok(None) };
            let at = |point: &AccuracyAt| (point.scan_s - promised.scan_s).abs() < 1e-9;
            let same_trials = by_time.points().into_iter().find(at).map_or(0.0, |p| p.accuracy);
            let measured = named(Some(promised.scan_s))?;
            Ok(Some(Checked { promised, same_trials, measured, whole }))
        })
        .collect()
}

fn halves(run: &Run<'_, '_>, entries: &[Entry]) -> Result<(), Failure> {
    let numbers: BTreeSet<u32> = entries.iter().map(|e| e.key.number).collect();
    let goals = GOALS.map(|(_, goal)| goal);
    let mut checked: Vec<Vec<Checked>> = GOALS.iter().map(|_| Vec::new()).collect();
    for split in 0..SPLITS {
        let mut order: Vec<u32> = numbers.iter().copied().collect();
        order.shuffle(&mut seed::rng(split, &[b"promise"]));
        let first: BTreeSet<u32> = order[..order.len() / 2].iter().copied().collect();
        let (from, to): (Vec<usize>, Vec<usize>) =
            (0..entries.len()).partition(|&i| first.contains(&entries[i].key.number));
        for (all, found) in checked.iter_mut().zip(check(run, (&from, &to), &goals)?) {
            all.extend(found);
        }
    }
    println!(
        "{SPLITS} splits of the trial numbers into halves: promised by one half, measured on the \
         other.\n"
    );
    println!(
        "| goal | promises | scan time, mean (least to most) | promised | the same trials | \
         measured | measured − promised | intervals overlap | whole scans |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    for ((name, _), all) in GOALS.iter().zip(&checked) {
        let mean = |of: &dyn Fn(&Checked) -> f64| {
            all.iter().map(of).sum::<f64>() / all.len().max(1) as f64
        };
        let times = || all.iter().map(|c| c.promised.scan_s);
        println!(
            "| {name} | {} of {SPLITS} | {:.2} s ({:.1} to {:.1}) | {:.1} % | {:.1} % | {:.1} % | \
             {:+.1} | {} of {} | {:.1} % |",
            all.len(),
            mean(&|c| c.promised.scan_s),
            times().fold(f64::INFINITY, f64::min),
            times().fold(0.0, f64::max),
            100.0 * mean(&|c| c.promised.accuracy),
            100.0 * mean(&|c| c.same_trials),
            100.0 * mean(&|c| Checked::share(c.measured)),
            100.0 * mean(&|c| Checked::share(c.measured) - c.promised.accuracy),
            all.iter().filter(|c| c.overlaps()).count(),
            all.len(),
            100.0 * mean(&|c| Checked::share(c.whole)),
        );
    }
    Ok(())
}

fn left_out_users(
    run: &Run<'_, '_>,
    entries: &[Entry],
    users: &BTreeSet<&str>,
) -> Result<(), Failure> {
    println!("Promised by the other people's trials, measured on this person's.\n");
    println!(
        "| person | goal | scan time | promised (95 % interval) | measured | measured − promised | \
         intervals overlap | whole scans |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    let goals = GOALS.map(|(_, goal)| goal);
    for user in users {
        let (to, from): (Vec<usize>, Vec<usize>) =
            (0..entries.len()).partition(|&i| entries[i].key.user == *user);
        let found = check(run, (&from, &to), &goals)?;
        for ((name, _), checked) in GOALS.iter().zip(found) {
            let Some(c) = checked else {
                println!("| {user} | {name} | none | – | – | – | – | – |");
                continue;
            };
            println!(
                "| {user} | {name} | {:.1} s | {:.1} % ({:.1} to {:.1}) | {:.1} % | {:+.1} | {} | \
                 {:.1} % |",
                c.promised.scan_s,
                100.0 * c.promised.accuracy,
                100.0 * c.promised.accuracy_low,
                100.0 * c.promised.accuracy_high,
                100.0 * Checked::share(c.measured),
                100.0 * (Checked::share(c.measured) - c.promised.accuracy),
                if c.overlaps() { "yes" } else { "no" },
                100.0 * Checked::share(c.whole),
            );
        }
    }
    Ok(())
}
