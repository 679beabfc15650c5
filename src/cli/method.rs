//! Which method compares trials, and with what settings.

use std::path::Path;

use super::Failure;
use crate::evaluate::plan::{Plan, Setting};
use crate::recognise::classify::{
    AdaBoost, Distance, NaiveBayes, Neighbours, OnFeatures, RandomForest, Svm,
};
use crate::recognise::{
    AnyMethod, Embedding, EmbeddingOptions, MethodName, PositionMode, Precision, Reference,
    ReferenceOptions, STAGES,
};
use crate::scene::Scene;

/// How positions are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Positions {
    /// Once a repetition, for the whole library.
    Shared,
    /// Anew for each pair of trials, as the authors' program does.
    PerPair,
}

/// Settings of a method.
#[derive(Clone, Debug, clap::Args)]
pub struct MethodArgs {
    /// How trials are compared (default: embedding, or the one whose options are given)
    #[arg(long, value_enum, value_name = "METHOD")]
    method: Option<MethodName>,
    /// With `reference`: how sample positions are drawn (default: shared)
    #[arg(long, value_enum)]
    positions: Option<Positions>,
    /// With `reference`: samples drawn from a source, n (default: 400)
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    n: Option<usize>,
    /// With `reference`: repetitions whose scores are averaged, R (default: 10)
    #[arg(long, value_name = "R", value_parser = at_least_one)]
    repetitions: Option<usize>,
    /// With `reference`: nearest library trials that vote, k (default: 1)
    #[arg(long, value_name = "K", value_parser = at_least_one)]
    neighbours: Option<usize>,
    /// Seed of everything that is drawn at random
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
    /// With `reference`: sum kernels in f64 throughout: slower, and equal to within 1e-4 of a score
    #[arg(long)]
    exact: bool,
    /// With `embedding`: let the nearest trial win, instead of training a discriminant
    #[arg(long)]
    no_discriminant: bool,
    /// With `embedding`: harmonics of each band, 1 to 4 (default: 4, or 2 for several channels)
    #[arg(long, value_name = "H", value_parser = clap::value_parser!(u8).range(1..=4))]
    harmonics: Option<u8>,
    /// With `reference`: compare all trials by one repetition, the best 64 by two, the best 16 by all
    #[arg(long)]
    halving: bool,
    /// With `reference`: do not tabulate library sums: quicker to prepare, slower to compare
    #[arg(long)]
    no_tables: bool,
    /// Neither read nor write the cache of prepared trials beside the library
    #[arg(long)]
    no_cache: bool,
}

/// Parses a count.
pub fn at_least_one(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(0) | Err(_) => Err("expected a whole number, 1 or more".into()),
        Ok(number) => Ok(number),
    }
}

impl MethodArgs {
    /// A method with its usual settings, but for `reference` the quick way.
    pub fn quick(method: MethodName) -> Self {
        Self {
            method: Some(method),
            positions: None,
            n: None,
            repetitions: None,
            neighbours: None,
            seed: 1,
            exact: false,
            harmonics: None,
            no_discriminant: false,
            halving: method == MethodName::Reference,
            no_tables: false,
            no_cache: true,
        }
    }

    /// The method that was asked for, by name or by options that it alone has.
    fn name(&self) -> Result<MethodName, Failure> {
        let counts = [self.n, self.repetitions, self.neighbours];
        let of_reference = counts.iter().any(Option::is_some)
            || self.positions.is_some()
            || self.exact
            || self.halving
            || self.no_tables;
        let of_embedding = self.no_discriminant || self.harmonics.is_some();
        let by_options =
            [(of_reference, MethodName::Reference), (of_embedding, MethodName::Embedding)];
        let mut named = self.method;
        for (_, its) in by_options.into_iter().filter(|(given, _)| *given) {
            match named {
                Some(other) if other != its => {
                    return Err(Failure::Usage(format!(
                        "an option was given that goes with --method {} alone, not with {}; see \
                         --help",
                        its.name(),
                        other.name()
                    )));
                }
                _ => named = Some(its),
            }
        }
        Ok(named.unwrap_or(MethodName::Embedding))
    }

    /// The method that was asked for, on the sources of a scene.
    ///
    /// # Errors
    /// Wrong usage, if options of different methods are given.
    pub fn method(&self, scene: &Scene) -> Result<AnyMethod, Failure> {
        let name = self.name()?;
        let (scene, seed) = (scene.clone(), self.seed);
        let neighbours =
            |scene, distance| AnyMethod::new(OnFeatures::new(scene, Neighbours { distance }));
        Ok(match name {
            MethodName::Reference => {
                AnyMethod::new(Reference::new(scene, self.reference_options()))
            }
            MethodName::Embedding => {
                AnyMethod::new(Embedding::new(scene, self.embedding_options()))
            }
            MethodName::NaiveBayes => AnyMethod::new(OnFeatures::new(scene, NaiveBayes)),
            MethodName::Svm => AnyMethod::new(OnFeatures::new(scene, Svm)),
            MethodName::Knn => neighbours(scene, Distance::Euclidean),
            MethodName::Mahalanobis => neighbours(scene, Distance::Mahalanobis),
            MethodName::Adaboost => AnyMethod::new(OnFeatures::new(scene, AdaBoost { seed })),
            MethodName::RandomForest => {
                AnyMethod::new(OnFeatures::new(scene, RandomForest { seed }))
            }
        })
    }

    /// These settings, but for what a plan says.
    pub fn planned(&self, plan: &Plan) -> Self {
        let planned = Self { method: Some(plan.setting.method()), ..self.clone() };
        match plan.setting {
            Setting::Reference { n, repetitions } => {
                Self { n: Some(n), repetitions: Some(repetitions), ..planned }
            }
            Setting::Embedding => planned,
        }
    }

    /// The settings of `embedding`.
    pub fn embedding_options(&self) -> EmbeddingOptions {
        EmbeddingOptions {
            discriminant: !self.no_discriminant,
            harmonics: self.harmonics.map(usize::from),
            ..EmbeddingOptions::default()
        }
    }

    /// Where prepared trials of a library in a folder are kept, if they are.
    pub fn cache_beside<'a>(&self, library: &'a Path) -> Option<&'a Path> {
        (!self.no_cache).then_some(library)
    }

    /// The settings of `reference`.
    pub fn reference_options(&self) -> ReferenceOptions {
        let usual = ReferenceOptions::default();
        ReferenceOptions {
            samples: self.n.unwrap_or(usual.samples),
            repetitions: self.repetitions.unwrap_or(usual.repetitions),
            neighbours: self.neighbours.unwrap_or(usual.neighbours),
            positions: match self.positions {
                None | Some(Positions::Shared) => PositionMode::Shared,
                Some(Positions::PerPair) => PositionMode::PerPair,
            },
            seed: self.seed,
            precision: if self.exact { Precision::Oracle } else { Precision::Fast },
            tabulate: !self.no_tables,
            halving: if self.halving { STAGES.to_vec() } else { Vec::new() },
        }
    }
}
