//! Accuracy on short series in which the place says most: the spectrum of each recording, as a
//! spectrometer would give it, is named instead of the recording. Prints a table.
//!
//!     cargo run --release --example spectra -- cross_user/boreal finger_slides …
//!
//! Each series becomes 28 samples a channel: ln of the mean power in 28 equal bands up to half its rate.
//! Protocols are those that the data allow, leaving people out if there are several; accuracies are means
//! over seeds 1 to 12, since one seed may lie ten points from the next.

use std::error::Error;
use std::path::Path;

use surfaced::dataset;
use surfaced::evaluate::{Evaluation, Protocol, folds};
use surfaced::recognise::{Embedding, EmbeddingOptions, Method, MethodName, MethodSpec};
use surfaced::scene::{Domain, Scene};
use surfaced::spectrum::amplitude_spectrum;
use surfaced::trial::{Series, Signal, Trial};

const BINS: usize = 28;
const SEEDS: u64 = 12;

fn main() -> Result<(), Box<dyn Error>> {
    println!("| library | protocol | `embedding`, % | `svm`, % |\n|---|---|---|---|");
    for path in std::env::args().skip(1) {
        let library = dataset::open(Path::new(&path), &Scene::lmt108())?;
        let scene = library.scene.changed(|spec| {
            spec.domain = Domain::Time { band_hz: None };
            spec.rate_hz = None;
        });
        let entries: Vec<_> = library.entries.into_iter().map(|e| e.changed(spectra)).collect();
        let keys: Vec<_> = entries.iter().map(|entry| entry.key.clone()).collect();
        let mut asked = vec![Protocol::ExpertVsUsers, Protocol::AllVsOneUser];
        asked.retain(|&protocol| folds(protocol, &keys).is_ok());
        if asked.is_empty() {
            asked.push(Protocol::LeaveOneTrialOut);
        }
        for protocol in asked {
            let folds = folds(protocol, &keys)?;
            let accuracy = |method: &dyn Method| -> Result<f64, Box<dyn Error>> {
                let run = Evaluation::new(&scene, &entries, &folds).prepare(method)?;
                Ok(100.0 * run.measure()?.outcome.share.value())
            };
            let mut embedding = 0.0;
            for seed in 1..=SEEDS {
                let method = Embedding::new(scene.clone(), EmbeddingOptions { seed });
                embedding += accuracy(&method)? / SEEDS as f64;
            }
            let svm = accuracy(&*MethodSpec::from(MethodName::Svm).build(&scene))?;
            println!("| {} | {} | {embedding:.1} | {svm:.1} |", library.name, protocol.name());
        }
    }
    Ok(())
}

fn spectra(mut trial: Trial) -> Trial {
    for signal in trial.signals.values_mut() {
        if let Signal::Series(series) = signal {
            *series = spectrum(series);
        }
    }
    trial
}

fn spectrum(series: &Series) -> Series {
    let (channels, rate_hz) = (series.channels(), series.rate_hz());
    let of_channel = |channel: usize| -> Vec<f32> {
        let samples = series.samples().iter().skip(channel).step_by(channels);
        let samples: Vec<f64> = samples.map(|x| f64::from(*x)).collect();
        let mean = samples.iter().sum::<f64>() / samples.len() as f64;
        let centred = samples.iter().map(|x| x - mean).collect::<Vec<_>>();
        let amplitudes = amplitude_spectrum(centred.into_iter(), rate_hz, (0.0, 0.5 * rate_hz));
        let band = |bin: usize| {
            let place = |bin: usize| bin * amplitudes.len() / BINS;
            let of_bin = &amplitudes[place(bin)..place(bin + 1).max(place(bin) + 1)];
            let power = of_bin.iter().map(|x| x * x).sum::<f64>() / of_bin.len() as f64;
            (power + 1e-12).ln() as f32
        };
        (0..BINS).map(band).collect()
    };
    let of_channels: Vec<Vec<f32>> = (0..channels).map(of_channel).collect();
    let at = |i: usize| of_channels[i % channels][i / channels];
    Series::new(4.0, channels, (0..BINS * channels).map(at).collect())
        .expect("28 finite samples a channel")
}
