//! What a MATLAB level 5 file is made of, and how much of it is read.

use crate::trial::Series;

/// No variable of a trial is larger: [`Series::MOST_SAMPLES`] in doubles.
pub(super) const MAX_BYTES: usize = Series::MOST_SAMPLES * 8;
/// As many doubles.
pub(super) const MAX_NUMBERS: usize = MAX_BYTES / 8;
/// Cells of a variable in all, and letters of each text: enough for the names of 60,000 trials. A
/// few bytes of a compressed file may stand for any number of empty cells.
pub(super) const MAX_CELLS: usize = 1 << 16;
pub(super) const MAX_LETTERS: usize = 1 << 20;
/// Cells within cells within cells.
pub(super) const MAX_DEPTH: usize = 8;
/// Longest name of a variable, and most dimensions.
pub(super) const MAX_NAME: usize = 256;
pub(super) const MAX_DIMS: usize = 16;

pub(super) const UTF8: u32 = 16;
pub(super) const UTF16: u32 = 17;
pub(super) const UTF32: u32 = 18;

/// Why bytes are not a level 5 file, or not one that can be read.
#[derive(Debug, PartialEq, thiserror::Error)]
pub enum MatError {
    /// the bytes end too early
    #[error(
        "the MATLAB file is cut short; copy it again from where it came, or save it again with \
         save(…, '-v7')"
    )]
    CutShort,
    /// level 7.3, which is HDF5
    #[error(
        "a MATLAB file of version 7.3 (HDF5), which is not read; open it in MATLAB and save it \
         again with save('NAME.mat', '-v7')"
    )]
    Version73,
    /// no such file
    #[error(
        "not a MATLAB file of level 5; save it with save('NAME.mat', '-v7') in MATLAB, or with \
         scipy.io.savemat in Python"
    )]
    NotMatlab,
    /// what a level 5 file cannot hold
    #[error("damaged MATLAB file ({0}); copy it again from where it came, or save it again")]
    Damaged(&'static str),
    /// larger than any trial
    #[error(
        "a variable of the MATLAB file claims more than 128 MiB, or a list of more than 65,536 \
         names; it is not a trial of LMT108"
    )]
    TooLarge,
}

/// Order of bytes in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ByteOrder {
    /// Least significant first.
    Little,
    /// Most significant first.
    Big,
}

impl ByteOrder {
    pub(super) fn u16(self, bytes: [u8; 2]) -> u16 {
        match self {
            Self::Little => u16::from_le_bytes(bytes),
            Self::Big => u16::from_be_bytes(bytes),
        }
    }

    pub(super) fn u32(self, bytes: [u8; 4]) -> u32 {
        match self {
            Self::Little => u32::from_le_bytes(bytes),
            Self::Big => u32::from_be_bytes(bytes),
        }
    }

    pub(super) fn u64(self, bytes: [u8; 8]) -> u64 {
        match self {
            Self::Little => u64::from_le_bytes(bytes),
            Self::Big => u64::from_be_bytes(bytes),
        }
    }
}

/// What an array is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// Real numbers; `byte` where they are stored as uint8.
    Numbers {
        /// whether the class is uint8
        byte: bool,
    },
    /// Text.
    Char,
    /// Arrays of any class.
    Cell,
    /// Something that is not read, by name.
    Other(&'static str),
}

/// Name and shape of a variable.
#[derive(Clone, Debug, PartialEq)]
pub struct Variable {
    /// Its name.
    pub name: String,
    /// Its class.
    pub class: Class,
    /// Its dimensions, rows first.
    pub dims: Vec<usize>,
}

/// Contents of an array.
#[derive(Clone, Debug, PartialEq)]
pub enum ArrayValues {
    /// Column after column.
    Numbers(Vec<f64>),
    /// One text a row, without spaces at the end.
    Text(Vec<String>),
    /// Column after column.
    Cells(Vec<Array>),
    /// Not read.
    Unread,
}

/// A variable and its contents.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Name and shape.
    pub variable: Variable,
    /// Contents.
    pub values: ArrayValues,
}

impl Array {
    /// All texts in it, cell after cell, row after row.
    pub fn texts(&self) -> Vec<&str> {
        match &self.values {
            ArrayValues::Text(rows) => rows.iter().map(String::as_str).collect(),
            ArrayValues::Cells(cells) => cells.iter().flat_map(Array::texts).collect(),
            ArrayValues::Numbers(_) | ArrayValues::Unread => Vec::new(),
        }
    }
}
