//! Which method compares trials, and with what settings.

use std::path::Path;

use crate::recognise::{
    Embedding, EmbeddingOptions, Joint, Method, PositionMode, Precision, Reference,
    ReferenceOptions, STAGES,
};
use crate::scene::Scene;

/// The methods, by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum MethodName {
    /// The paper's method, exactly.
    Reference,
    /// The kernel two-sample test on samples that keep where they came from.
    Joint,
    /// Fourier features and a shrinkage discriminant.
    Embedding,
}

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

impl MethodArgs {
    /// Does `work` with the method that was asked for, on the sources of `scene`.
    pub fn apply<W: WithMethod>(&self, scene: &Scene, work: W) -> W::Output {
        match self.method {
            MethodName::Joint => work.with(Joint::new(scene.clone())),
            MethodName::Embedding => {
                work.with(Embedding::new(scene.clone(), self.embedding_options()))
            }
            MethodName::Reference => {
                work.with(Reference::new(scene.clone(), self.reference_options()))
            }
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
