//! Which method compares trials.

/// The methods, by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, serde::Deserialize)]
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
    pub fn all() -> &'static [Self] {
        clap::ValueEnum::value_variants()
    }

    /// The name on the command line.
    pub fn name(self) -> &'static str {
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
