//! Compares the synthetic scene with the paper: accuracy of the method `reference` on 108 generated
//! surfaces, expert against users, for each source, for all eight, and without the mean shift.
//!
//!     cargo run --release --example synth_pattern
//!     cargo run --release --example synth_pattern -- --users 3 --sources ca1,ir ir-level=-0.7,0.8,0.3,0.05
//!
//! Arguments of the form `quantity=centre,surface,user,trial` try other constants of the scene.

use std::collections::BTreeSet;
use std::error::Error;

use surfaced::dataset::synth::{self, Difficulty, Effect, Parameters};
use surfaced::evaluate::{self, Evaluation, Protocol};
use surfaced::recognise::{Reference, ReferenceOptions, STAGES};
use surfaced::replication::{ALL, rows};
use surfaced::scene::{Scene, SourceId};

/// The setting in Table II that the paper then uses for each source.
const SINGLES: [(&str, &str); 8] = [
    ("ca1", "ca1, HSV, no shift"),
    ("ca2", "ca2, HSV, no shift"),
    ("mi1", "mi1, spectrum, shift"),
    ("mi2", "mi2, spectrum, shift"),
    ("ac", "ac, spectrum, shift"),
    ("fr", "fr, time, shift"),
    ("ir", "ir, time, shift"),
    ("me", "me, time, no shift"),
];
const UNSHIFTED: &str = "all, without the shift";

fn main() -> Result<(), Box<dyn Error>> {
    let mut parameters = Parameters { difficulty: Difficulty::lmt108(), ..Parameters::default() };
    let mut only: Option<Vec<String>> = None;
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        let mut value = || words.next().ok_or(format!("{word} needs a value"));
        match word.as_str() {
            "--users" => parameters.users = value()?.parse()?,
            "--surfaces" => parameters.surfaces = value()?.parse()?,
            "--seed" => parameters.seed = value()?.parse()?,
            "--sources" => only = Some(value()?.split(',').map(String::from).collect()),
            other => change(&mut parameters.difficulty, other)?,
        }
    }
    let wanted = |name: &str| only.as_ref().is_none_or(|only| only.iter().any(|o| o == name));
    let mut settings = Vec::new();
    for (source, name) in SINGLES.into_iter().filter(|(source, _)| wanted(source)) {
        settings.push((source, name, Scene::lmt108().only(&[SourceId::new(source)?])?));
    }
    if wanted("all") {
        let unshifted = Scene::lmt108().changed(|spec| spec.align_mean = false);
        settings.push((ALL, ALL, Scene::lmt108()));
        settings.push((UNSHIFTED, UNSHIFTED, unshifted));
    }
    let mut sources = BTreeSet::new();
    settings.iter().for_each(|(.., scene)| sources.extend(scene.sources().map(|s| s.id.clone())));
    let sources: Vec<SourceId> = sources.into_iter().collect();
    let every = Scene::lmt108().only(&sources)?;

    let library = synth::library(&parameters);
    let entries: Vec<_> = library.entries.into_iter().map(|entry| entry.within(&every)).collect();
    let keys: Vec<_> = entries.iter().map(|entry| entry.key.clone()).collect();
    let folds = evaluate::folds(Protocol::ExpertVsUsers, &keys)?;
    println!("| setting | synthetic, % | paper, % | difference |");
    println!("|---|---|---|---|");
    for (shown, name, scene) in settings {
        let narrowed: Vec<_> = entries.iter().map(|entry| entry.clone().within(&scene)).collect();
        let method = method(&scene);
        let run = Evaluation::new(&scene, &narrowed, &folds).prepare(&method)?;
        let outcome = run.measure()?.outcome;
        let published = rows()
            .into_iter()
            .find(|row| row.protocol == Protocol::ExpertVsUsers && row.name == name)
            .and_then(|row| row.published)
            .ok_or(format!("the paper has no row {name}"))?;
        let ours = 100.0 * outcome.accuracy_mean;
        println!(
            "| {shown} | {ours:.1} ± {:.1} | {:.1} | {:+.1} |",
            100.0 * outcome.accuracy_std.unwrap_or(f64::NAN),
            published.accuracy,
            ours - published.accuracy
        );
    }
    Ok(())
}

fn method(scene: &Scene) -> Reference {
    let options = ReferenceOptions { halving: STAGES.to_vec(), ..ReferenceOptions::default() };
    Reference::new(scene.clone(), options)
}

fn change(d: &mut Difficulty, word: &str) -> Result<(), Box<dyn Error>> {
    let (name, values) = word.split_once('=').ok_or(format!("{word}: expected name=values"))?;
    let values: Vec<f64> = values.split(',').map(str::parse).collect::<Result<_, _>>()?;
    let effect = d.effects.get_mut(&*name.replace('-', " "));
    match (effect, values.as_slice(), name) {
        (Some(effect), &[centre, surface, user, trial], _) => {
            *effect = Effect { centre, surface, user, trial };
        }
        (None, &[x], "force-drift") => d.force_drift = x,
        (None, &[x], "metal-fraction") => d.metal_fraction = x,
        (None, &[x], "metal-correlation-s") => d.metal_correlation_s = x,
        _ => {
            return Err(
                format!("{word}: no such quantity, or not the right number of values").into()
            );
        }
    }
    Ok(())
}
