//! Files of arrays: which array holds the trials, and which arrays or files their labels.

use std::collections::BTreeMap;
use std::path::Path;

use super::array::{Array, Trials};
use super::cell::shown;
use super::columns::runs_surely;
use super::gather::Rows;
use super::mat::MatFile;
use super::names::trial_number;
use super::{Form, OnRead, Said, give, lines, npy, session_name};
use crate::library::LibraryError;
use crate::printable::counted;
use crate::trial::{EXPERT, TrialKey, normal};

/// Whether a file holds arrays, by its name.
pub fn is_array(path: &Path) -> bool {
    ["npy", "npz", "mat"].iter().any(|extension| is_called(path, extension))
}

fn is_called(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|of| of.eq_ignore_ascii_case(extension))
}

/// The surface, user, trial and session of each trial, as far as arrays or files tell them.
type Labels = [Option<Vec<String>>; 4];

/// Opens the array of trials in a file: the one that `form` names, or the only one that may be meant.
pub fn open(path: &Path, form: &Form) -> Result<(Trials, Labels), LibraryError> {
    let (name, most) = (form.variable.as_deref(), form.most_unpacked);
    let of =
        |name: &Option<String>| name.as_ref().map(|name| labels_of(path, name, most)).transpose();
    let [surface, user, trial, session] = form.labels.each_ref().map(of);
    let labels = [surface?, user?, trial?, session?];
    let count = labels.iter().flatten().next().map(Vec::len);
    let trials = match is_called(path, "mat") {
        true => MatFile::open(path, most)?.trials(name, count),
        false => Trials::of(npy::open(path, name, most)?, count),
    };
    Ok((trials.map_err(LibraryError::at(path))?, labels))
}

/// Reads all trials of an array, like [`super::read`].
pub fn read(path: &Path, form: &Form, on: OnRead<'_>) -> Result<Said, LibraryError> {
    let fail = LibraryError::at(path);
    let (trials, labels) = open(path, form)?;
    if form.rate_hz().is_none() {
        return Err(fail("an array has no column of times; give --rate HZ".into()));
    }
    let (count, channels) = (trials.count, trials.channels);
    if let Some(labels) = labels.iter().flatten().find(|labels| labels.len() != count) {
        let mut problem =
            format!("it has {}, but there are {} labels", counted(count, "trial"), labels.len());
        if [count, channels].map(|many| many + 1).contains(&labels.len()) {
            problem += &format!("; the first, `{}`, may be a header: remove it", labels[0]);
        }
        return Err(fail(problem));
    }
    let of_name = form.of_name(path);
    let mut of_name = match labels[0] {
        Some(_) => of_name.unwrap_or_default(),
        None => of_name.map_err(|why| fail(format!("{why}, or give --labels")))?,
    };
    of_name[3] = form.session_of(path).map_err(fail)?;
    let label = |what: usize, trial: usize| match &labels[what] {
        Some(labels) => Some(labels[trial].clone()),
        None => of_name[what].clone(),
    };
    let place = |name: &String| name.parse::<usize>().ok()?.checked_sub(1);
    let places: Option<Vec<usize>> = form.columns().iter().map(place).collect();
    let places =
        places.ok_or_else(|| fail("the channels of an array are called 1, 2, …".into()))?;
    if let Some(place) = places.iter().find(|place| **place >= channels) {
        return Err(fail(format!("it has no channel {}, but {channels} channels", place + 1)));
    }
    let (mut said, mut numbers) = (Said::default(), BTreeMap::<_, u32>::new());
    let mut at = 0;
    for array in trials.arrays {
        for values in array.and_then(Array::trials).map_err(fail)? {
            let values = values.map_err(fail)?;
            let samples = values.len() / channels;
            let surface = normal(&label(0, at).unwrap_or_default());
            let user = normal(&label(1, at).unwrap_or_else(|| EXPERT.into()));
            let session = label(3, at).filter(|session| !session.is_empty());
            let session = session.as_deref().map(session_name).transpose().map_err(fail)?;
            let of_file = of_name[2].as_deref().and_then(trial_number).filter(|_| count == 1);
            at += 1;
            if surface.is_empty() || user.is_empty() {
                return Err(fail(format!("trial {at} has no label")));
            }
            let next = numbers.entry((surface.clone(), user.clone())).or_default();
            *next += 1;
            let key = TrialKey::new(surface, user, of_file.unwrap_or(*next)).with_session(session);
            // As in tables, an infinity is a missing value.
            let value = |at: usize| if values[at].is_finite() { values[at] } else { f32::NAN };
            if at == 1 {
                let runs = |place: &&usize| {
                    let own = &values[**place * samples..(**place + 1) * samples];
                    runs_surely(&own.iter().map(|x| f64::from(*x)).collect::<Vec<_>>())
                };
                let running = places.iter().filter(runs).map(|place| (place + 1).to_string());
                said.running = running.collect();
            }
            let row = |row: usize| places.iter().map(move |place| place * samples + row);
            let values = (0..samples).flat_map(row).map(value).collect();
            on(std::slice::from_ref(&key), None)?;
            give(path, key, Rows { times: Vec::new(), values }, form, None, &mut said, on)?;
        }
    }
    Ok(said)
}

/// Labels of an array's trials: an array of the same file, or a file with one label a line or one array.
fn labels_of(path: &Path, labels: &str, most: u64) -> Result<Vec<String>, LibraryError> {
    let file = Path::new(labels);
    let (of, name) = if file.is_file() { (file, None) } else { (path, Some(labels)) };
    let fail = LibraryError::at(of);
    if name.is_some() && is_called(of, "npy") {
        return Err(fail(format!("there is no file `{labels}`, and a .npy holds no other array")));
    }
    if is_called(of, "mat") {
        return MatFile::open(of, most)?.labels(name).map_err(fail);
    }
    if is_array(of) {
        return npy::open(of, name, most)?.labels().map_err(fail);
    }
    let (mut lines, mut all) = (lines(of, most)?, Vec::new());
    while let Some((number, line)) = lines.next().map_err(fail)? {
        let line = shown(line.trim_ascii());
        let quoted = line.strip_prefix('"').and_then(|line| line.strip_suffix('"'));
        let quoted = quoted.filter(|label| !label.contains('"'));
        if quoted.is_none() && line.contains([',', ';', '\t']) {
            return Err(fail(format!(
                "line {number}, `{line}`, has several columns; expected a label a line, in quotation \
                 marks if it holds a comma"
            )));
        }
        all.extend(Some(quoted.unwrap_or(&line).to_string()).filter(|label| !label.is_empty()));
    }
    Ok(all)
}
