//! The table of the methods that compare trials, with their settings.

use serde::{Deserialize, Serialize};

use super::classify::{AdaBoost, Distance, NaiveBayes, Neighbours, OnFeatures, RandomForest, Svm};
use super::embedding::{Embedding, EmbeddingOptions};
use super::method::Method;
use super::reference::{Reference, ReferenceOptions};
use crate::scene::Scene;

/// Upper limit of every count in the settings: samples, repetitions, neighbours.
pub const MOST_COUNT: usize = 1_000_000;

/// Defines [`MethodName`] and [`MethodSpec`] from one table. Each line holds a method, its
/// settings, its name as text, its help, and how it is built from a scene and its settings.
macro_rules! methods {
    ($($name:ident($options:ty) = $text:literal, $help:literal, |$scene:ident, $set:pat_param| $build:expr;)*) => {
        /// The methods.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
        pub enum MethodName {
            $(#[doc = $help] #[serde(rename = $text)] $name,)*
        }

        impl MethodName {
            /// All methods.
            pub const ALL: [Self; [$($text),*].len()] = [$(Self::$name),*];

            /// The name as text, the same in commands, files and output.
            pub const fn as_str(self) -> &'static str {
                match self { $(Self::$name => $text,)* }
            }

            /// A short description of the method.
            pub(crate) fn help(self) -> &'static str {
                match self { $(Self::$name => $help,)* }
            }
        }

        /// A method with its settings.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "method")]
        pub enum MethodSpec {
            $(#[doc = $help] #[serde(rename = $text)] $name($options),)*
        }

        impl From<MethodName> for MethodSpec {
            /// The method with its default settings.
            fn from(name: MethodName) -> Self {
                match name { $(MethodName::$name => Self::$name(<$options>::default()),)* }
            }
        }

        impl MethodSpec {
            /// The name of the method.
            pub fn name(&self) -> MethodName {
                match self { $(Self::$name(_) => MethodName::$name,)* }
            }

            /// The method, ready for the sources of a scene.
            pub fn build(&self, scene: &Scene) -> Box<dyn Method> {
                match self {
                    $(Self::$name($set) => {
                        let $scene = scene.clone();
                        Box::new($build)
                    })*
                }
            }
        }
    };
}

methods! {
    Reference(ReferenceOptions) = "reference", "The paper's method, exactly",
        |scene, options| Reference::new(scene, options.clone());
    Embedding(EmbeddingOptions) = "embedding", "Fourier features and a shrinkage discriminant",
        |scene, options| Embedding::new(scene, options.clone());
    NaiveBayes(NoOptions) = "naive-bayes", "Hand-made features: Gaussian naive Bayes",
        |scene, _| OnFeatures::new(MethodName::NaiveBayes.as_str(), scene, NaiveBayes);
    Svm(NoOptions) = "svm", "Hand-made features: support vector machine with RBF kernel",
        |scene, _| OnFeatures::new(MethodName::Svm.as_str(), scene, Svm);
    Knn(NoOptions) = "knn", "Hand-made features: nearest neighbours",
        |scene, _| OnFeatures::new(MethodName::Knn.as_str(), scene, Neighbours { distance: Distance::Euclidean });
    Mahalanobis(NoOptions) = "mahalanobis",
        "Hand-made features: nearest neighbours by Mahalanobis distance",
        |scene, _| OnFeatures::new(MethodName::Mahalanobis.as_str(), scene, Neighbours { distance: Distance::Mahalanobis });
    Adaboost(TreeOptions) = "adaboost", "Hand-made features: boosted trees",
        |scene, options| OnFeatures::new(MethodName::Adaboost.as_str(), scene, AdaBoost { seed: options.seed });
    RandomForest(TreeOptions) = "random-forest", "Hand-made features: random forest",
        |scene, options| OnFeatures::new(MethodName::RandomForest.as_str(), scene, RandomForest { seed: options.seed });
}

/// Empty settings, for a method that has none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoOptions {}

/// Settings of the tree-based methods.
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
