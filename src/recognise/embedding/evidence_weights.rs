//! How much each stretch of a vector speaks for each class: the evidence of one source.

use std::ops::Range;

use ndarray::{Array1, Array2, ArrayView1, s};

/// What makes inner products with the class means of vectors, stretch by stretch.
pub struct EvidenceWeights {
    /// Shape (C, D).
    pub(super) of_class: Array2<f32>,
    /// One a class.
    pub(super) offset: Array1<f64>,
}

impl EvidenceWeights {
    /// u·m_c, taken apart by stretches of the vector: how much each speaks for the class. The
    /// class's distance is |u|² + |m_c|² less twice their sum.
    pub fn terms(
        &self,
        class: usize,
        vector: ArrayView1<'_, f32>,
        stretches: &[Range<usize>],
    ) -> Vec<f64> {
        let offset = self.offset[class] / stretches.len() as f64;
        let term = |stretch: &Range<usize>| {
            let stretch = s![stretch.clone()];
            let own = self.of_class.row(class).slice(stretch).dot(&vector.slice(stretch));
            f64::from(own) - offset
        };
        stretches.iter().map(term).collect()
    }
}
