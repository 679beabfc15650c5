//! What a data element holds: numbers of any width, or letters.

use super::format::{ByteOrder, MAX_LETTERS, MAX_NUMBERS, MatError, UTF8, UTF16, UTF32};

/// Numbers of any of the storage types.
pub(super) fn numbers(order: ByteOrder, kind: u32, data: &[u8]) -> Result<Vec<f64>, MatError> {
    fn each<const N: usize>(
        data: &[u8],
        to: impl Fn([u8; N]) -> f64,
    ) -> Result<Vec<f64>, MatError> {
        let (chunks, rest) = data.as_chunks::<N>();
        if chunks.len() > MAX_NUMBERS {
            return Err(MatError::TooLarge);
        }
        if !rest.is_empty() {
            return Err(MatError::Damaged("half a number"));
        }
        Ok(chunks.iter().map(|&bytes| to(bytes)).collect())
    }
    match kind {
        1 => each(data, |b: [u8; 1]| f64::from(b[0] as i8)),
        2 => each(data, |b: [u8; 1]| f64::from(b[0])),
        3 => each(data, |b| f64::from(order.u16(b) as i16)),
        4 => each(data, |b| f64::from(order.u16(b))),
        5 => each(data, |b| f64::from(order.u32(b) as i32)),
        6 => each(data, |b| f64::from(order.u32(b))),
        7 => each(data, |b| f64::from(f32::from_bits(order.u32(b)))),
        9 => each(data, |b| f64::from_bits(order.u64(b))),
        12 => each(data, |b| order.u64(b) as i64 as f64),
        13 => each(data, |b| order.u64(b) as f64),
        _ => Err(MatError::Damaged("numbers of an unknown type")),
    }
}

/// The letters of a text in any of the codes.
pub(super) fn letters(order: ByteOrder, kind: u32, data: &[u8]) -> Result<Vec<char>, MatError> {
    if data.len() > MAX_LETTERS {
        return Err(MatError::TooLarge);
    }
    match kind {
        1 | 2 | UTF8 => Ok(String::from_utf8_lossy(data).chars().collect()),
        4 | UTF16 => {
            let units = data.as_chunks::<2>().0.iter().map(|&bytes| order.u16(bytes));
            Ok(char::decode_utf16(units)
                .map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER))
                .collect())
        }
        UTF32 => {
            let codes = data.as_chunks::<4>().0.iter().map(|&bytes| order.u32(bytes));
            Ok(codes.map(|c| char::from_u32(c).unwrap_or(char::REPLACEMENT_CHARACTER)).collect())
        }
        _ => Err(MatError::Damaged("text of an unknown type")),
    }
}

/// The rows of a matrix of letters, stored column after column.
pub(super) fn rows(letters: &[char], count: usize) -> Vec<String> {
    let row = |row: usize| {
        let text: String = letters.iter().skip(row).step_by(count.max(1)).collect();
        text.trim_end_matches([' ', '\0']).to_string()
    };
    (0..count.min(letters.len())).map(row).collect()
}
