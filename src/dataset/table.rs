//! Feature tables: CSV files with hand-made features of trials instead of recordings.
//!
//! Each file is a source of the file's name. Its header begins with `file,surface,split,trial`;
//! each further line holds these four values of a trial and a number for each feature. The split
//! `train` means the expert, any other the user with the trial's number.

use std::collections::BTreeMap;
use std::path::Path;

use crate::library::LibraryError;
use crate::library::files::{self, Listed};
use crate::scene::SourceId;
use crate::trial::{EXPERT, TrialKey};

const NAMES: &str = "file,surface,split,trial,";

/// Feature tables of some trials.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureTables {
    /// Name of the folder.
    pub name: String,
    /// The sources: the names of the files.
    pub sources: Vec<SourceId>,
    /// For each trial and source, the features in the order of the columns.
    pub trials: BTreeMap<TrialKey, BTreeMap<SourceId, Vec<f64>>>,
}

/// Opens the feature tables in a folder; `None` if it holds none.
///
/// # Errors
/// If a table cannot be read, has a line with more or fewer fields than its header, a value that is
/// not a finite number, or a trial twice.
pub fn open(folder: &Path) -> Result<Option<FeatureTables>, LibraryError> {
    let is_csv = |item: &Listed| !item.is_dir && item.name.ends_with(".csv");
    let mut tables = FeatureTables {
        name: folder.file_name().unwrap_or(folder.as_os_str()).to_string_lossy().into_owned(),
        sources: Vec::new(),
        trials: BTreeMap::new(),
    };
    for item in files::list(folder)?.iter().filter(|item| is_csv(item)) {
        let bytes = files::read_bytes(&item.path, files::MOST_TEXT)?;
        if bytes.starts_with(NAMES.as_bytes()) {
            let stem = item.name.trim_end_matches(".csv");
            let id = SourceId::new(stem)
                .map_err(|error| LibraryError::file(&item.path, error.to_string()))?;
            read(&bytes, &id, &mut tables.trials)
                .map_err(|problem| LibraryError::file(&item.path, problem))?;
            tables.sources.push(id);
        }
    }
    Ok((!tables.trials.is_empty()).then_some(tables))
}

/// The number of the line that holds a row of a CSV text, from 1 on. The crate `csv` gives the line
/// of the first blank line before the row.
pub(crate) fn line_of(text: &[u8], row: &csv::StringRecord) -> u64 {
    let Some(start) = row.position() else { return 0 };
    let after = text.get(start.byte() as usize..).unwrap_or_default();
    let blank = after.iter().take_while(|byte| matches!(byte, b'\r' | b'\n'));
    start.line() + blank.filter(|byte| **byte == b'\n').count() as u64
}

fn read(
    text: &[u8],
    id: &SourceId,
    trials: &mut BTreeMap<TrialKey, BTreeMap<SourceId, Vec<f64>>>,
) -> Result<(), String> {
    let mut reader =
        csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(text);
    let columns = reader.headers().map_err(|error| error.to_string())?.len();
    for row in reader.records() {
        let row = row.map_err(|error| error.to_string())?;
        let line = line_of(text, &row);
        if row.iter().all(str::is_empty) && row.len() <= 1 {
            continue;
        }
        if row.len() != columns {
            let found = row.len();
            return Err(format!("line {line} has {found} fields; the header has {columns}"));
        }
        let trial = row[3]
            .parse()
            .map_err(|_| format!("line {line}: trial is `{}`; expected a whole number", &row[3]))?;
        let user = if &row[2] == "train" { EXPERT.into() } else { format!("user{trial}") };
        let values = row.iter().enumerate().skip(4).map(|(at, field)| {
            field.parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(|| {
                format!("line {line}, column {}: `{field}` is not a finite number", at + 1)
            })
        });
        let values = values.collect::<Result<Vec<f64>, String>>()?;
        let key = TrialKey::new(&row[1], user, trial);
        if trials.entry(key.clone()).or_default().insert(id.clone(), values).is_some() {
            return Err(format!("line {line}: {key} is there twice"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: &str = "file,surface,split,trial,T_max,T_min\na,Oak,train,2,1.5,-2e-3\n";

    fn open_with(name: &str, text: &str) -> Result<Option<FeatureTables>, LibraryError> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(name), text).unwrap();
        open(folder.path())
    }

    #[test]
    fn a_table_is_a_source() {
        let tables = open_with("snd.csv", TABLE).unwrap().unwrap();
        let key = TrialKey::new("Oak", EXPERT, 2);
        assert_eq!(tables.trials[&key]["snd"], [1.5, -2e-3]);
        assert_eq!(tables.sources.len(), 1);
    }

    #[test]
    fn what_is_no_table_is_left_alone() {
        assert_eq!(open_with("x.csv", "a,b\n1,2\n").unwrap(), None);
        assert_eq!(open_with("x.txt", TABLE).unwrap(), None);
    }

    #[test]
    fn bad_lines_are_named() {
        for (bad, message) in [
            ("a,Oak,train,3,1\n", "line 3 has 5 fields; the header has 6"),
            ("a,Oak,train,x,1,2\n", "line 3: trial is `x`"),
            ("a,Oak,train,3,1,nan\n", "line 3, column 6: `nan`"),
            ("b,Oak,train,2,1,2\n", "line 3: Oak · expert · trial 2 is there twice"),
        ] {
            let error = open_with("x.csv", &format!("{TABLE}{bad}")).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
        }
    }
}
