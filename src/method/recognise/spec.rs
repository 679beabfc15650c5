//! The methods that compare trials, with their settings, in one table.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::classify::smartcore_models::{boosted, forest, naive_bayes};
use super::classify::{OnFeatures, neighbours, svm};
use super::embedding::{Embedding, EmbeddingOptions};
use super::error::Result;
use super::method::{Method, Model};
use super::ready_model::ready_model;
use super::reference::{Reference, ReferenceOptions};
use crate::library::Library;
use crate::scene::Scene;

/// Upper limit of each count in the settings: samples, repetitions and neighbours.
pub const MOST_COUNT: usize = 1_000_000;

/// Defines [`MethodName`] and [`MethodSpec`] from one table. Each row holds a method, its settings,
/// its name as text, its help, and the code that builds it from a scene and its settings.
macro_rules! methods {
    ($($name:ident($options:ty) = $text:literal, $help:literal, |$scene:ident, $set:pat_param| $build:expr;)*) => {
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
        pub enum MethodName {
            $(#[doc = $help] #[serde(rename = $text)] $name,)*
        }

        impl MethodName {
            pub const ALL: [Self; [$($text),*].len()] = [$(Self::$name),*];

            /// The name as text, the same in commands, files and output.
            pub const fn as_str(self) -> &'static str {
                match self { $(Self::$name => $text,)* }
            }

            pub fn help(self) -> &'static str {
                match self { $(Self::$name => $help,)* }
            }
        }

        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "method")]
        pub enum MethodSpec {
            $(#[doc = $help] #[serde(rename = $text)] $name($options),)*
        }

        impl From<MethodName> for MethodSpec {
            fn from(name: MethodName) -> Self {
                match name { $(MethodName::$name => Self::$name(<$options>::default()),)* }
            }
        }

        impl MethodSpec {
            pub fn name(&self) -> MethodName {
                match self { $(Self::$name(_) => MethodName::$name,)* }
            }

            pub fn build(&self, scene: &Scene) -> Box<dyn Method> {
                match self {
                    $(Self::$name(set) => {
                        let ($scene, $set) = (scene.clone(), set);
                        Box::new($build)
                    })*
                }
            }
        }
    };
}

impl MethodSpec {
    /// Fits a model to all trials of a library; [`ready_model`] does so with caches and progress.
    ///
    /// # Errors
    /// If a trial cannot be read or does not fit the scene, and the errors of [`Method::fit`].
    pub fn fit(&self, library: &Library) -> Result<Arc<dyn Model>> {
        let all = (0..library.entries.len()).collect();
        let method = self.build(&library.scene);
        Ok(ready_model(&*method, &library.entries, &all, None, &|_, _| ())?.model)
    }

    /// The same method with another seed; `None` if it draws nothing at random.
    pub fn seeded(&self, seed: u64) -> Option<Self> {
        match self {
            Self::Reference(options) => {
                Some(Self::Reference(ReferenceOptions { seed, ..options.clone() }))
            }
            Self::Embedding(_) => Some(Self::Embedding(EmbeddingOptions { seed })),
            Self::Adaboost(_) => Some(Self::Adaboost(TreeOptions { seed })),
            Self::RandomForest(_) => Some(Self::RandomForest(TreeOptions { seed })),
            Self::NaiveBayes(_) | Self::Svm(_) | Self::Knn(_) | Self::Mahalanobis(_) => None,
        }
    }
}

methods! {
    Reference(ReferenceOptions) = "reference", "The paper's method, exactly",
        |scene, options| Reference::new(scene, options.clone());
    Embedding(EmbeddingOptions) = "embedding", "Fourier features and a shrinkage discriminant",
        |scene, options| Embedding::new(scene, options.clone());
    NaiveBayes(NoOptions) = "naive-bayes", "Hand-made features: Gaussian naive Bayes",
        |scene, _| OnFeatures::new("naive-bayes", scene, |trials| naive_bayes(trials));
    Svm(NoOptions) = "svm", "Hand-made features: support vector machine with RBF kernel",
        |scene, _| OnFeatures::new("svm", scene, svm::learn);
    Knn(NoOptions) = "knn", "Hand-made features: nearest neighbours",
        |scene, _| OnFeatures::new("knn", scene, |trials| neighbours::learn(trials, false));
    Mahalanobis(NoOptions) = "mahalanobis",
        "Hand-made features: nearest neighbours by Mahalanobis distance",
        |scene, _| OnFeatures::new("mahalanobis", scene, |trials| neighbours::learn(trials, true));
    Adaboost(TreeOptions) = "adaboost", "Hand-made features: boosted trees",
        |scene, &TreeOptions { seed }| {
            OnFeatures::new("adaboost", scene, move |trials| boosted(trials, seed))
        };
    RandomForest(TreeOptions) = "random-forest", "Hand-made features: random forest",
        |scene, &TreeOptions { seed }| {
            OnFeatures::new("random-forest", scene, move |trials| forest(trials, seed))
        };
}

/// Empty settings, for a method that has none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoOptions {}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TreeOptions {
    pub seed: u64,
}

impl Default for TreeOptions {
    fn default() -> Self {
        Self { seed: 1 }
    }
}
