//! Stores numbers as one run of little-endian bytes, which is far quicker to read than single numbers:
//! frames and, by `#[serde(with = "…")]`, matrices of stored trials and models.

use multiversion::multiversion;
use ndarray::{Array1, Array2, ArrayView1};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::lanes::products;

/// Log-band frames in fixed point, with 2⁻⁹ of a unit of ln power as step. This is finer than any
/// estimate of power, and takes half the memory of f32.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PackedFrames {
    #[serde(with = "list")]
    values: Vec<i16>,
}

/// Number of fixed-point steps in one unit of ln power.
const STEPS: f32 = 512.0;

impl PackedFrames {
    pub fn new(values: &[f32]) -> Self {
        let mut packed = vec![0; values.len()];
        pack(values, &mut packed);
        Self { values: packed }
    }

    pub(super) fn extend(&mut self, other: &Self) {
        self.values.extend_from_slice(&other.values);
    }

    /// All values, as ln power.
    pub fn values(&self) -> Vec<f32> {
        self.part(self.values.len(), 0..1)
    }

    /// The frames `within`, each of `width` values, as ln power.
    pub fn part(&self, width: usize, within: std::ops::Range<usize>) -> Vec<f32> {
        let values = &self.values[within.start * width..within.end * width];
        values.iter().map(|&x| f32::from(x) / STEPS).collect()
    }
}

/// Without SSE 4.1, `f32::round` is a function call.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn pack(values: &[f32], packed: &mut [i16]) {
    for i in 0..values.len().min(packed.len()) {
        packed[i] =
            (values[i] * STEPS).round().clamp(f32::from(i16::MIN), f32::from(i16::MAX)) as i16;
    }
}

/// A matrix in fixed point: each row in steps of 1/32767 of its largest number. It takes half the memory
/// of f32, and half the time where a product waits for memory.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct PackedMatrix {
    columns: usize,
    /// The step of each row.
    steps: Vec<f32>,
    #[serde(with = "list")]
    values: Vec<i16>,
}

impl PackedMatrix {
    /// Takes finite numbers.
    pub(crate) fn new(matrix: &Array2<f64>) -> Self {
        let largest = |row: ArrayView1<'_, f64>| row.fold(0.0, |most: f64, x| most.max(x.abs()));
        let steps: Vec<f64> =
            matrix.rows().into_iter().map(|row| largest(row) / f64::from(i16::MAX)).collect();
        let in_steps = |(row, step): (ArrayView1<'_, f64>, &f64)| {
            let step = step.max(f64::MIN_POSITIVE);
            row.iter().map(|x| (x / step).round() as i16).collect::<Vec<_>>()
        };
        let values = matrix.rows().into_iter().zip(&steps).flat_map(in_steps).collect();
        Self {
            columns: matrix.ncols(),
            steps: steps.iter().map(|step| *step as f32).collect(),
            values,
        }
    }

    /// Whether a stored matrix has this shape.
    pub(crate) fn is_of(&self, (rows, columns): (usize, usize)) -> bool {
        [self.steps.len(), self.columns] == [rows, columns]
            && Some(self.values.len()) == rows.checked_mul(columns)
    }

    pub(crate) fn len(&self) -> usize {
        self.values.len()
    }

    pub(crate) fn matrix(&self) -> Array2<f32> {
        Array2::from_shape_fn((self.steps.len(), self.columns), |(row, column)| {
            self.steps[row] * f32::from(self.values[row * self.columns + column])
        })
    }

    /// The inner product of each row with a vector.
    pub(crate) fn products(&self, vector: &[f32]) -> Array1<f64> {
        let in_steps = products(&self.values, vector);
        in_steps.into_iter().zip(&self.steps).map(|(x, step)| x * f64::from(*step)).collect()
    }
}

/// Bytes that are written as one run, not as a list.
struct Bytes(Vec<u8>);

impl Serialize for Bytes {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_bytes(&self.0)
    }
}

/// Reads numbers of `N` bytes each; fails if bytes are left over.
fn numbers<const N: usize, T, E: Error>(
    bytes: &[u8],
    number: impl Fn([u8; N]) -> T,
) -> Result<Vec<T>, E> {
    let (parts, rest) = bytes.as_chunks();
    if !rest.is_empty() {
        return Err(E::invalid_length(bytes.len(), &"whole numbers"));
    }
    Ok(parts.iter().map(|part| number(*part)).collect())
}

pub(super) mod list {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(values: &[i16], to: S) -> Result<S::Ok, S::Error> {
        let bytes: Vec<_> = values.iter().map(|x| x.to_le_bytes()).collect();
        Bytes(bytes.into_flattened()).serialize(to)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<i16>, D::Error> {
        numbers(<&[u8]>::deserialize(from)?, i16::from_le_bytes)
    }
}

/// A matrix, row by row.
pub(crate) mod matrix {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(matrix: &Array2<f32>, to: S) -> Result<S::Ok, S::Error> {
        let bytes: Vec<_> = matrix.iter().map(|x| x.to_le_bytes()).collect();
        (matrix.dim(), Bytes(bytes.into_flattened())).serialize(to)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Array2<f32>, D::Error> {
        let (shape, bytes) = <((usize, usize), &[u8])>::deserialize(from)?;
        let matrix = Array2::from_shape_vec(shape, numbers(bytes, f32::from_le_bytes)?);
        matrix.map_err(D::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fixed_point_is_finer_than_a_hundredth() {
        let values = [-32.236, 0.001, 7.5, 88.7];
        let packed = PackedFrames::new(&values);
        let out = packed.part(2, 0..2);
        for (a, b) in values.iter().zip(&out).take(3) {
            assert!((a - b).abs() <= 0.5 / STEPS);
        }
        assert!(out[3] > 63.9, "beyond any sound, and held there");
        let bytes = postcard::to_allocvec(&packed).unwrap();
        assert_eq!(postcard::from_bytes::<PackedFrames>(&bytes).unwrap(), packed);
    }
}
