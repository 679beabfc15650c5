//! Which method compares trials, and with what settings.

use std::path::Path;

use crate::evaluate::plan::Setting;
use crate::recognise::classify::{
    AdaBoost, Distance, NaiveBayes, Neighbours, OnFeatures, RandomForest, Svm,
};
use crate::recognise::features::FeatureVector;
use crate::recognise::{
    Embedding, EmbeddingOptions, Joint, Method, MethodName, PositionMode, Precision, Reference,
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
    /// How trials are compared
    #[arg(long, value_enum, default_value = "reference", value_name = "METHOD")]
    method: MethodName,
    /// How sample positions are drawn
    #[arg(long, value_enum, default_value = "shared")]
    positions: Positions,
    /// Samples drawn from a source (n)
    #[arg(long, default_value_t = 400, value_name = "N", value_parser = at_least_one)]
    n: usize,
    /// Repetitions whose scores are averaged (R)
    #[arg(long, default_value_t = 10, value_name = "R", value_parser = at_least_one)]
    repetitions: usize,
    /// Nearest library trials that vote (k)
    #[arg(long, default_value_t = 1, value_name = "K", value_parser = at_least_one)]
    neighbours: usize,
    /// Seed of everything that is drawn at random
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
    /// Sum kernels in f64 throughout: slower, and equal to within 1e-4 of a score
    #[arg(long)]
    exact: bool,
    /// With `embedding`: let the nearest trial win, instead of training a discriminant
    #[arg(long)]
    no_discriminant: bool,
    /// With `embedding`: harmonics of each band, 1 to 4 (default: 4, or 2 for several channels)
    #[arg(long, value_name = "H", value_parser = clap::value_parser!(u8).range(1..=4))]
    harmonics: Option<u8>,
    /// Compare all trials by one repetition, the best 64 by two, the best 16 by all
    #[arg(long)]
    halving: bool,
    /// Do not tabulate library sums: quicker to prepare, slower to compare
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

/// Work that any method can do.
pub trait WithMethod {
    /// What comes of it.
    type Output;

    /// Does the work.
    fn with(self, method: impl Method + 'static) -> Self::Output;
}

/// Work that methods on hand-made features can do.
pub trait WithClassifier {
    /// What comes of it.
    type Output;

    /// Does the work.
    fn with(self, method: impl Method<Prepared = FeatureVector> + 'static) -> Self::Output;
}

/// Work for any method, done with a classifier.
struct AnyMethod<W>(W);

impl<W: WithMethod> WithClassifier for AnyMethod<W> {
    type Output = W::Output;

    fn with(self, method: impl Method<Prepared = FeatureVector> + 'static) -> W::Output {
        self.0.with(method)
    }
}

impl MethodArgs {
    /// A method with its usual settings, but for `reference` the quick way.
    pub fn quick(method: MethodName) -> Self {
        Self {
            method,
            positions: Positions::Shared,
            n: 400,
            repetitions: 10,
            neighbours: 1,
            seed: 1,
            exact: false,
            harmonics: None,
            no_discriminant: false,
            halving: true,
            no_tables: false,
            no_cache: true,
        }
    }

    /// Does `work` with the method that was asked for, on the sources of `scene`.
    pub fn apply<W: WithMethod>(&self, scene: &Scene, work: W) -> W::Output {
        let work = match self.apply_to_features(scene, AnyMethod(work)) {
            Ok(output) => return output,
            Err(AnyMethod(work)) => work,
        };
        match self.method {
            MethodName::Joint => work.with(Joint::new(scene.clone())),
            MethodName::Embedding => {
                work.with(Embedding::new(scene.clone(), self.embedding_options()))
            }
            _ => work.with(Reference::new(scene.clone(), self.reference_options())),
        }
    }

    /// These settings, but for what a plan says.
    pub fn planned(&self, setting: Setting) -> Self {
        let planned = Self { method: setting.method(), ..self.clone() };
        match setting {
            Setting::Reference { n, repetitions } => Self { n, repetitions, ..planned },
            Setting::Joint | Setting::Embedding => planned,
        }
    }

    /// The same, if the method works on hand-made features; else gives the work back.
    ///
    /// # Errors
    /// The work itself, if the method needs recordings.
    pub fn apply_to_features<W: WithClassifier>(
        &self,
        scene: &Scene,
        work: W,
    ) -> Result<W::Output, W> {
        let seed = self.seed;
        let neighbours = |distance| OnFeatures::new(scene.clone(), Neighbours { distance });
        Ok(match self.method {
            MethodName::NaiveBayes => work.with(OnFeatures::new(scene.clone(), NaiveBayes)),
            MethodName::Svm => work.with(OnFeatures::new(scene.clone(), Svm)),
            MethodName::Knn => work.with(neighbours(Distance::Euclidean)),
            MethodName::Mahalanobis => work.with(neighbours(Distance::Mahalanobis)),
            MethodName::Adaboost => work.with(OnFeatures::new(scene.clone(), AdaBoost { seed })),
            MethodName::RandomForest => {
                work.with(OnFeatures::new(scene.clone(), RandomForest { seed }))
            }
            MethodName::Reference | MethodName::Joint | MethodName::Embedding => return Err(work),
        })
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
        ReferenceOptions {
            samples: self.n,
            repetitions: self.repetitions,
            neighbours: self.neighbours,
            positions: match self.positions {
                Positions::Shared => PositionMode::Shared,
                Positions::PerPair => PositionMode::PerPair,
            },
            seed: self.seed,
            precision: if self.exact { Precision::Oracle } else { Precision::Fast },
            tabulate: !self.no_tables,
            halving: if self.halving { STAGES.to_vec() } else { Vec::new() },
        }
    }
}
