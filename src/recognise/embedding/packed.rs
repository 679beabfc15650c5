//! Stores numbers as one run of little-endian bytes, which is far quicker to read than one number
//! after the other. For `#[serde(with = "…")]` in stored trials and models.

use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Bytes that are written in one run, not as a list.
struct Bytes(Vec<u8>);

impl Serialize for Bytes {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_bytes(&self.0)
    }
}

/// Reads numbers of `N` bytes each; an error if bytes are left over.
fn numbers<const N: usize, T, E: Error>(
    bytes: &[u8],
    number: fn([u8; N]) -> T,
) -> Result<Vec<T>, E> {
    let (parts, rest) = bytes.as_chunks();
    if !rest.is_empty() {
        return Err(E::invalid_length(bytes.len(), &"whole numbers"));
    }
    Ok(parts.iter().map(|part| number(*part)).collect())
}

/// A list of 16-bit numbers.
pub mod list {
    use super::*;

    /// Writes the list.
    pub fn serialize<S: Serializer>(values: &[i16], to: S) -> Result<S::Ok, S::Error> {
        Bytes(values.iter().flat_map(|x| x.to_le_bytes()).collect()).serialize(to)
    }

    /// Reads the list.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<i16>, D::Error> {
        numbers(<&[u8]>::deserialize(from)?, i16::from_le_bytes)
    }
}

/// A matrix, row by row.
pub mod matrix {
    use super::*;
    use ndarray::Array2;

    /// Writes its shape and its values.
    pub fn serialize<S: Serializer>(matrix: &Array2<f32>, to: S) -> Result<S::Ok, S::Error> {
        let bytes = Bytes(matrix.iter().flat_map(|x| x.to_le_bytes()).collect());
        (matrix.dim(), bytes).serialize(to)
    }

    /// Reads the matrix.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Array2<f32>, D::Error> {
        let (shape, bytes) = <((usize, usize), &[u8])>::deserialize(from)?;
        let matrix = Array2::from_shape_vec(shape, numbers(bytes, f32::from_le_bytes)?);
        matrix.map_err(D::Error::custom)
    }
}
