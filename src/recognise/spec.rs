//! Which method compares trials, and with what settings: the one way to say so.

use serde::{Deserialize, Serialize};

use super::classify::{AdaBoost, Distance, NaiveBayes, Neighbours, OnFeatures, RandomForest, Svm};
use super::embedding::{Embedding, EmbeddingOptions};
use super::method::Method;
use super::reference::{Reference, ReferenceOptions};
use crate::scene::Scene;

/// The most of anything that settings may count: samples, repetitions, neighbours.
pub const MOST_COUNT: usize = 1_000_000;

/// The methods.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MethodName {
    /// The paper's method, exactly.
    Reference,
    /// Fourier features and a shrinkage discriminant.
    Embedding,
    /// Hand-made features: Gaussian naive Bayes.
    NaiveBayes,
    /// Hand-made features: support vector machine with RBF kernel.
    Svm,
    /// Hand-made features: nearest neighbours.
    Knn,
    /// Hand-made features: nearest neighbours by Mahalanobis distance.
    Mahalanobis,
    /// Hand-made features: boosted trees.
    Adaboost,
    /// Hand-made features: random forest.
    RandomForest,
}

impl MethodName {
    /// All of them.
    pub const ALL: [Self; 8] = [
        Self::Reference,
        Self::Embedding,
        Self::NaiveBayes,
        Self::Svm,
        Self::Knn,
        Self::Mahalanobis,
        Self::Adaboost,
        Self::RandomForest,
    ];

    /// The name as text, the same everywhere.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Reference => "reference",
            Self::Embedding => "embedding",
            Self::NaiveBayes => "naive-bayes",
            Self::Svm => "svm",
            Self::Knn => "knn",
            Self::Mahalanobis => "mahalanobis",
            Self::Adaboost => "adaboost",
            Self::RandomForest => "random-forest",
        }
    }
}

/// A method with its settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "method", rename_all = "kebab-case")]
pub enum MethodSpec {
    /// The paper's method, exactly.
    Reference(ReferenceOptions),
    /// Fourier features and a shrinkage discriminant.
    Embedding(EmbeddingOptions),
    /// Gaussian naive Bayes.
    NaiveBayes(NoOptions),
    /// Support vector machine.
    Svm(NoOptions),
    /// Nearest neighbours.
    Knn(NoOptions),
    /// Nearest neighbours by Mahalanobis distance.
    Mahalanobis(NoOptions),
    /// Boosted trees.
    Adaboost(TreeOptions),
    /// Random forest.
    RandomForest(TreeOptions),
}

/// Settings of a method that has none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoOptions {}

/// Settings of methods by trees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TreeOptions {
    /// Seed of all draws.
    pub seed: u64,
}

impl Default for TreeOptions {
    fn default() -> Self {
        Self { seed: 1 }
    }
}

impl From<MethodName> for MethodSpec {
    /// The method with its usual settings.
    fn from(name: MethodName) -> Self {
        match name {
            MethodName::Reference => Self::Reference(ReferenceOptions::default()),
            MethodName::Embedding => Self::Embedding(EmbeddingOptions::default()),
            MethodName::NaiveBayes => Self::NaiveBayes(NoOptions {}),
            MethodName::Svm => Self::Svm(NoOptions {}),
            MethodName::Knn => Self::Knn(NoOptions {}),
            MethodName::Mahalanobis => Self::Mahalanobis(NoOptions {}),
            MethodName::Adaboost => Self::Adaboost(TreeOptions::default()),
            MethodName::RandomForest => Self::RandomForest(TreeOptions::default()),
        }
    }
}

impl MethodSpec {
    /// Which method it is.
    pub fn name(&self) -> MethodName {
        match self {
            Self::Reference(_) => MethodName::Reference,
            Self::Embedding(_) => MethodName::Embedding,
            Self::NaiveBayes(_) => MethodName::NaiveBayes,
            Self::Svm(_) => MethodName::Svm,
            Self::Knn(_) => MethodName::Knn,
            Self::Mahalanobis(_) => MethodName::Mahalanobis,
            Self::Adaboost(_) => MethodName::Adaboost,
            Self::RandomForest(_) => MethodName::RandomForest,
        }
    }

    /// The method, on the sources of a scene.
    pub fn build(&self, scene: &Scene) -> Box<dyn Method> {
        let scene = scene.clone();
        match self {
            Self::Reference(options) => Box::new(Reference::new(scene, options.clone())),
            Self::Embedding(options) => Box::new(Embedding::new(scene, options.clone())),
            Self::NaiveBayes(_) => Box::new(OnFeatures::new(scene, NaiveBayes)),
            Self::Svm(_) => Box::new(OnFeatures::new(scene, Svm)),
            Self::Knn(_) => {
                let distance = Distance::Euclidean;
                Box::new(OnFeatures::new(scene, Neighbours { distance }))
            }
            Self::Mahalanobis(_) => {
                let distance = Distance::Mahalanobis;
                Box::new(OnFeatures::new(scene, Neighbours { distance }))
            }
            Self::Adaboost(TreeOptions { seed }) => {
                Box::new(OnFeatures::new(scene, AdaBoost { seed: *seed }))
            }
            Self::RandomForest(TreeOptions { seed }) => {
                Box::new(OnFeatures::new(scene, RandomForest { seed: *seed }))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spec_survives_being_written_and_says_only_what_is_unusual() {
        for name in MethodName::ALL {
            let spec = MethodSpec::from(name);
            let text = toml::to_string(&spec).unwrap();
            assert_eq!(toml::from_str::<MethodSpec>(&text).unwrap(), spec, "{text}");
            assert_eq!(spec.name(), name);
            assert_eq!(spec.build(&Scene::lmt108()).name(), name.as_str());
        }
        let options = ReferenceOptions { samples: 100, repetitions: 1, ..Default::default() };
        let text = toml::to_string(&MethodSpec::Reference(options)).unwrap();
        assert_eq!(text, "method = \"reference\"\nn = 100\nrepetitions = 1\n");
    }

    #[test]
    fn settings_of_another_method_are_refused() {
        let spec = |text: &str| toml::from_str::<MethodSpec>(text);
        assert!(spec("method = \"reference\"\nneighbours = 3").is_ok());
        for text in
            ["method = \"embedding\"\nn = 3", "method = \"svm\"\nn = 3", "method = \"joint\""]
        {
            assert!(spec(text).is_err(), "{text}");
        }
    }
}
