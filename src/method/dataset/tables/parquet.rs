//! Parquet files: tables whose columns have names and types. Each row becomes a line of cells, which is
//! read by the rules of all tables. Whole numbers and times keep each digit, and numbers with fractions
//! are written as the shortest text that is read back as the same number.

use std::fs::File;
use std::io::{self, Cursor, Read};

use ::parquet::basic::{ConvertedType, LogicalType, TimeUnit, Type};
use ::parquet::column::reader::{ColumnReader, ColumnReaderImpl};
use ::parquet::data_type::{AsBytes, DataType, Int96};
use ::parquet::errors::ParquetError;
use ::parquet::file::reader::{FileReader, SerializedFileReader};
use ::parquet::schema::types::ColumnDescriptor;

use super::array::half;
use super::heading::Column;
use super::layout::Layout;
use super::text::{Limited, Lines, TOO_LARGE, is_read};
use crate::library::series_file::guarded;

pub(super) const MAGIC: &[u8] = b"PAR1";
const ROWS: usize = 128;
/// Longest text in a cell, in bytes.
const MOST_CELL: usize = 4096;
/// 1970-01-01 as the day of a Julian calendar, from which old timestamps count.
const JULIAN_1970: i64 = 2_440_588;
const DAY_NS: i64 = 86_400_000_000_000;

/// The meaning of a column's whole numbers, or the way its bytes become text.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Form {
    Number,
    Unsigned,
    /// Digits behind the point.
    Decimal(usize),
    /// Days since 1970.
    Date,
    /// Local time since 1970; its unit in nanoseconds.
    Local(i64),
    Half,
    Text,
}

/// The rows of a file as lines.
struct Rows {
    file: SerializedFileReader<File>,
    forms: Vec<Form>,
    /// The next group of rows, the columns of the current one, and how many of its rows are left.
    group: usize,
    columns: Vec<ColumnReader>,
    left: usize,
    text: Cursor<Vec<u8>>,
}

/// The lines of a file, of at most `most` bytes.
pub(super) fn lines(file: File, most: u64) -> Result<Lines, String> {
    let file = guarded(|| SerializedFileReader::new(file).map_err(said), damaged)?;
    let about = file.metadata();
    let chunks = about.row_groups().iter().flat_map(|group| group.columns());
    let sizes = chunks.map(|chunk| u64::try_from(chunk.uncompressed_size()).unwrap_or(u64::MAX));
    if sizes.fold(0, u64::saturating_add) > most {
        return Err(TOO_LARGE.into());
    }
    let described = about.file_metadata().schema_descr().columns();
    let forms = described.iter().map(|column| form(column)).collect::<Result<Vec<_>, _>>()?;
    let names = described.iter().map(|column| column.name().to_string()).collect();
    let mut columns = Column::named(names);
    for (column, (form, unit)) in columns.iter_mut().zip(&forms) {
        column.unit = unit.map(str::to_string).or(column.unit.take());
        column.is_numeric =
            unit.is_none() && !matches!(form, Form::Date | Form::Local(_) | Form::Text);
    }
    let forms = forms.into_iter().map(|(form, _)| form).collect();
    let (columns, layout) = (Vec::new(), Layout::typed(columns));
    let rows = Rows { file, forms, group: 0, columns, left: 0, text: Cursor::default() };
    Ok(Lines::records(Box::new(Limited { from: rows, left: most }), layout))
}

fn said(error: ParquetError) -> String {
    format!("the Parquet file is damaged, or of a form that is not read: {error}")
}

/// The error in place of a panic: the crate does not promise to refuse every damaged file by an error.
fn damaged(_: &str) -> String {
    "the Parquet file is damaged".into()
}

/// The form of a column, and the unit of its times.
fn form(column: &ColumnDescriptor) -> Result<(Form, Option<&'static str>), String> {
    let path = column.path().string();
    if column.path().parts().len() > 1 || column.max_rep_level() > 0 || column.max_def_level() > 1 {
        return Err(format!("column `{path}` is nested; write its parts as columns of their own"));
    }
    let unit = |unit: &TimeUnit| match unit {
        TimeUnit::MILLIS => ("ms", 1_000_000),
        TimeUnit::MICROS => ("us", 1000),
        TimeUnit::NANOS => ("ns", 1),
    };
    let scale = usize::try_from(column.type_scale()).unwrap_or(usize::MAX);
    use {ConvertedType as C, LogicalType as L};
    Ok(match (column.physical_type(), column.logical_type_ref(), column.converted_type()) {
        (Type::INT96, ..) => (Form::Number, Some("ns")),
        (Type::INT64, Some(L::Timestamp(time)), _) if !time.is_adjusted_to_u_t_c => {
            (Form::Local(unit(&time.unit).1), None)
        }
        (Type::INT32 | Type::INT64, Some(L::Timestamp(time) | L::Time(time)), _) => {
            (Form::Number, Some(unit(&time.unit).0))
        }
        (Type::INT32 | Type::INT64, None, C::TIMESTAMP_MILLIS | C::TIME_MILLIS) => {
            (Form::Number, Some("ms"))
        }
        (Type::INT64, None, C::TIMESTAMP_MICROS | C::TIME_MICROS) => (Form::Number, Some("us")),
        (Type::INT32, Some(L::Date), _) | (Type::INT32, None, C::DATE) => (Form::Date, None),
        (Type::INT32 | Type::INT64, _, C::DECIMAL) if scale <= 18 => (Form::Decimal(scale), None),
        (Type::INT32 | Type::INT64, _, C::UINT_8 | C::UINT_16 | C::UINT_32 | C::UINT_64) => {
            (Form::Unsigned, None)
        }
        (Type::INT32 | Type::INT64, None | Some(L::Integer(_)), _) => (Form::Number, None),
        (Type::BOOLEAN | Type::FLOAT | Type::DOUBLE, ..) => (Form::Number, None),
        (Type::BYTE_ARRAY, None | Some(L::String | L::Enum | L::Json), kind)
            if kind != C::DECIMAL =>
        {
            (Form::Text, None)
        }
        // Of a column that has no type, all cells are empty.
        (_, Some(L::Unknown), _) => (Form::Text, None),
        (Type::FIXED_LEN_BYTE_ARRAY, Some(L::Float16), _) => (Form::Half, None),
        (physical, logical, _) => {
            let kind =
                logical.map_or_else(|| physical.to_string(), |logical| format!("{logical:?}"));
            return Err(format!("column `{path}` is a {kind}; write it as a number or as text"));
        }
    })
}

impl Read for Rows {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if is_read(&self.text) {
            self.text = Cursor::new(guarded(|| self.next(), damaged).map_err(io::Error::other)?);
        }
        self.text.read(buffer)
    }
}

impl Rows {
    /// The next lines, each with its end; none behind the last.
    fn next(&mut self) -> Result<Vec<u8>, String> {
        while self.left == 0 {
            if self.group == self.file.num_row_groups() {
                return Ok(Vec::new());
            }
            let group = self.file.get_row_group(self.group).map_err(said)?;
            let columns = (0..self.forms.len()).map(|at| group.get_column_reader(at));
            self.columns = columns.collect::<Result<_, _>>().map_err(said)?;
            self.left = usize::try_from(group.metadata().num_rows()).unwrap_or(0);
            self.group += 1;
        }
        let mut lines = vec![Vec::new(); self.left.min(ROWS)];
        for (at, (column, form)) in self.columns.iter_mut().zip(&self.forms).enumerate() {
            if at > 0 {
                lines.iter_mut().for_each(|line| line.push(Layout::BETWEEN));
            }
            cells(column, *form, &mut lines)?;
        }
        self.left -= lines.len();
        lines.iter_mut().for_each(|line| line.push(Lines::RECORD_END));
        Ok(lines.concat())
    }
}

/// Appends the next cell of a column to each of the lines.
fn cells(column: &mut ColumnReader, form: Form, lines: &mut [Vec<u8>]) -> Result<(), String> {
    use ColumnReader as Of;
    match column {
        Of::BoolColumnReader(of) => each(of, lines, |x| number(u8::from(*x))),
        Of::Int32ColumnReader(of) if form == Form::Unsigned => {
            each(of, lines, |x| number(*x as u32))
        }
        Of::Int32ColumnReader(of) => each(of, lines, |x| whole(i64::from(*x), form)),
        Of::Int64ColumnReader(of) => each(of, lines, |x| whole(*x, form)),
        Of::Int96ColumnReader(of) => each(of, lines, |x| number(since_1970(x)?)),
        // A shorter text of an f32 may be rounded to another one by way of f64.
        Of::FloatColumnReader(of) => each(of, lines, |x| number(f64::from(*x))),
        Of::DoubleColumnReader(of) => each(of, lines, |x| number(*x)),
        Of::ByteArrayColumnReader(of) => each(of, lines, |x| text(x.as_bytes())),
        Of::FixedLenByteArrayColumnReader(of) => each(of, lines, |x| match x.as_bytes() {
            [low, high] => number(half(u16::from_le_bytes([*low, *high]))),
            _ => None,
        }),
    }
}

fn each<T: DataType>(
    column: &mut ColumnReaderImpl<T>,
    lines: &mut [Vec<u8>],
    cell: impl Fn(&T::T) -> Option<Vec<u8>>,
) -> Result<(), String> {
    let (mut levels, mut values) = (Vec::new(), Vec::new());
    let read = column.read_records(lines.len(), Some(&mut levels), None, &mut values);
    if read.map_err(said)?.0 != lines.len() {
        return Err("the Parquet file is damaged: a column has too few rows".into());
    }
    let mut values = values.iter();
    for (at, line) in lines.iter_mut().enumerate() {
        // A column in which no cell may be empty has no levels.
        if levels.get(at).is_none_or(|level| *level > 0)
            && let Some(value) = values.next()
        {
            let of_value = || "a cell holds no number, a time beyond all ranges, or 4 KiB of text";
            line.extend(cell(value).ok_or_else(of_value)?);
        }
    }
    Ok(())
}

fn number(number: impl ToString) -> Option<Vec<u8>> {
    Some(number.to_string().into_bytes())
}

fn whole(value: i64, form: Form) -> Option<Vec<u8>> {
    match form {
        Form::Unsigned => number(value as u64),
        Form::Decimal(scale) => {
            let digits = format!("{:0>1$}", value.unsigned_abs(), scale + 1);
            let (whole, fraction) = digits.split_at(digits.len() - scale);
            let (sign, point) =
                (if value < 0 { "-" } else { "" }, if scale > 0 { "." } else { "" });
            number(format!("{sign}{whole}{point}{fraction}"))
        }
        Form::Date => {
            let days = jiff::Span::new().try_days(value).ok()?;
            number(jiff::civil::date(1970, 1, 1).checked_add(days).ok()?)
        }
        Form::Local(unit_ns) => {
            let ns = i128::from(value) * i128::from(unit_ns);
            let time = jiff::Timestamp::from_nanosecond(ns).ok()?;
            number(jiff::tz::Offset::UTC.to_datetime(time))
        }
        Form::Number | Form::Half | Form::Text => number(value),
    }
}

/// An old timestamp, of a day and the nanoseconds within it, in nanoseconds.
fn since_1970(value: &Int96) -> Option<i64> {
    let [low, high, day] = *value.data() else { return None };
    let within = (u64::from(high) << 32 | u64::from(low)) as i64;
    (i64::from(day) - JULIAN_1970).checked_mul(DAY_NS)?.checked_add(within)
}

/// Text without what ends cells and lines.
fn text(bytes: &[u8]) -> Option<Vec<u8>> {
    let plain = |byte: &u8| if byte.is_ascii_control() { b' ' } else { *byte };
    (bytes.len() <= MOST_CELL).then(|| bytes.iter().map(plain).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text_of(cell: Option<Vec<u8>>) -> String {
        cell.map_or_else(String::new, |cell| String::from_utf8(cell).unwrap())
    }

    #[test]
    fn whole_numbers_and_times_keep_each_digit() {
        let ns = 1_700_000_000_123_456_789;
        for (value, form, right) in [
            (ns, Form::Number, "1700000000123456789"),
            (-1, Form::Unsigned, "18446744073709551615"),
            (-5, Form::Decimal(2), "-0.05"),
            (12345, Form::Decimal(2), "123.45"),
            (7, Form::Decimal(0), "7"),
            (19_737, Form::Date, "2024-01-15"),
            (ns, Form::Local(1), "2023-11-14T22:13:20.123456789"),
            (-1, Form::Local(1000), "1969-12-31T23:59:59.999999"),
            (i64::MAX, Form::Local(1_000_000), ""),
            (i64::MIN, Form::Date, ""),
        ] {
            assert_eq!(text_of(whole(value, form)), right);
        }
        let mut old = Int96::new();
        old.set_data(1_000_000_007, 0, JULIAN_1970 as u32 + 1);
        assert_eq!(since_1970(&old), Some(DAY_NS + 1_000_000_007));
        old.set_data(0, 0, u32::MAX);
        assert_eq!(since_1970(&old), None);
        assert_eq!(text_of(text(b"a\x1eb\x1fc")), "a b c");
    }

    #[test]
    fn a_file_unpacks_to_at_most_max_gb() {
        let open = || File::open("tests/fixtures/rows.parquet").unwrap();
        let refused = lines(open(), 100).err().unwrap();
        assert!(refused.contains("--max-gb"), "{refused}");
        let mut all = lines(open(), 2500).unwrap();
        let refused = std::iter::repeat_with(|| all.next().map(|line| line.is_some()));
        let refused = refused.take_while(|next| *next != Ok(false)).find_map(Result::err);
        assert!(refused.is_some_and(|refused| refused.contains("--max-gb")));
    }
}
