//! Feature tables: CSV files with hand-made features of trials, in place of recordings.
//!
//! Each file holds the features of one source, which has the file's name. Its header begins with
//! `file,surface,split,trial`; each further line holds these four values of a trial, and
//! a number for each feature. Trials of the split `train` are by the expert; in any other split,
//! trial u is by user u.

use std::collections::BTreeMap;
use std::path::Path;

use super::csv::CsvTable;
use crate::library::files::{self, Listed};
use crate::library::{LibraryError, digest_of};
use crate::scene::SourceId;
use crate::seed;
use crate::trial::{EXPERT, TrialKey};

const NAMES: &str = "file,surface,split,trial,";

#[derive(Clone, Debug, PartialEq)]
pub struct FeatureTables {
    pub name: String,
    pub sources: Vec<SourceId>,
    /// The features of each trial and source, in the order of the file's columns.
    pub trials: BTreeMap<TrialKey, BTreeMap<SourceId, Vec<f64>>>,
}

impl FeatureTables {
    /// Like [`crate::library::Library::digest`].
    pub fn digest(&self) -> String {
        let of = |trial| seed::stable_hash(&[format!("{trial:?}").as_bytes()]);
        digest_of(self.trials.iter().map(of).collect())
    }
}

/// Opens the feature tables in a folder; `None` if the folder has none.
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
            let id = SourceId::new(stem).map_err(LibraryError::at(&item.path))?;
            read(&bytes, &id, &mut tables.trials).map_err(LibraryError::at(&item.path))?;
            tables.sources.push(id);
        }
    }
    Ok((!tables.trials.is_empty()).then_some(tables))
}

fn read(
    text: &[u8],
    id: &SourceId,
    trials: &mut BTreeMap<TrialKey, BTreeMap<SourceId, Vec<f64>>>,
) -> Result<(), String> {
    let table = CsvTable::parse(text, true)?;
    for row in &table.rows {
        let (line, cells) = row;
        let trial = cells[3].parse().map_err(|_| {
            format!("line {line}: trial is `{}`; expected a whole number", cells[3])
        })?;
        let user = if cells[2] == "train" { EXPERT.into() } else { format!("user{trial}") };
        let values = (4..cells.len()).map(|column| table.value(row, column));
        let values = values.collect::<Result<Vec<f64>, String>>()?;
        let key = TrialKey::new(&cells[1], user, trial);
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
    fn a_table_is_a_source_and_what_is_no_table_is_left_alone() {
        let tables = open_with("snd.csv", TABLE).unwrap().unwrap();
        assert_eq!(tables.trials[&TrialKey::new("Oak", EXPERT, 2)]["snd"], [1.5, -2e-3]);
        assert_eq!(tables.sources.len(), 1);
        for (name, text) in [("x.csv", "a,b\n1,2\n"), ("x.txt", TABLE)] {
            assert_eq!(open_with(name, text).unwrap(), None);
        }
    }

    #[test]
    fn bad_lines_are_named() {
        for (bad, message) in [
            ("a,Oak,train,3,1\n", "line 3 has 5 columns; the first has 6"),
            ("a,Oak,train,x,1,2\n", "line 3: trial is `x`"),
            ("a,Oak,train,3,1,nan\n", "line 3, column `T_min`: `nan`"),
            ("b,Oak,train,2,1,2\n", "line 3: Oak · expert · trial 2 is there twice"),
        ] {
            let error = open_with("x.csv", &format!("{TABLE}{bad}")).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
        }
    }
}
