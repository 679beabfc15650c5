//! The part of the Python package `surfaced` that is computed in Rust. `python/surfaced` checks and documents it.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::{IntoPyArray, PyArray2, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use rayon::prelude::*;
use surfaced_method::dataset;
use surfaced_method::independence::{Question, report};
use surfaced_method::kernel::{Dependence, Threshold, test_independence};
use surfaced_method::library::{Entry, Library};
use surfaced_method::recognise::{EmbeddingOptions, MethodSpec, Model as Named, score_samples};
use surfaced_method::record::{TrialOptions, write_library_toml, write_trial};
use surfaced_method::scene::{Scene, SourceId};
use surfaced_method::seed;
use surfaced_method::trial::{Series, Signal, Trial, TrialKey};

fn refused(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Arrays of shape (channels, samples).
type Arrays<'py> = Vec<PyReadonlyArray2<'py, f32>>;

fn series(x: &Arrays<'_>, rate_hz: f64) -> PyResult<Vec<Series>> {
    let one = |(at, array): (usize, &PyReadonlyArray2<'_, f32>)| {
        // Frame by frame, as a series holds them.
        let samples = array.as_array().t().iter().copied().collect();
        Series::new(rate_hz, array.as_array().nrows(), samples)
            .map_err(|why| refused(format!("series {at} of X (counted from 0): {why}")))
    };
    x.iter().enumerate().map(one).collect()
}

/// How recordings came about: what each is of, who made it, and how it is sampled.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct About {
    labels: Vec<String>,
    users: Vec<String>,
    source: String,
    rate_hz: f64,
    band_hz: Option<(f64, f64)>,
}

fn library(x: &Arrays<'_>, about: &About) -> PyResult<(SourceId, Library)> {
    let source = SourceId::new(&about.source).map_err(refused)?;
    let keys = about.labels.iter().zip(&about.users).zip(1..);
    let keys = keys.map(|((surface, user), number)| TrialKey::new(surface, user, number));
    let library = Library::of_series(&source, about.band_hz, keys.zip(series(x, about.rate_hz)?));
    Ok((source, library.map_err(refused)?))
}

/// A fitted model.
#[pyclass(frozen)]
struct Model {
    model: Arc<dyn Named>,
    source: SourceId,
    rate_hz: f64,
}

#[pymethods]
impl Model {
    #[new]
    fn new(py: Python<'_>, x: Arrays<'_>, about: About, seed: u64) -> PyResult<Self> {
        let (source, library) = library(&x, &about)?;
        let method = MethodSpec::Embedding(EmbeddingOptions { seed });
        let model = py.detach(|| method.fit(&library)).map_err(refused)?;
        Ok(Self { model, source, rate_hz: about.rate_hz })
    }

    /// For each query, the surfaces and their probabilities, the most likely first.
    fn rank(&self, py: Python<'_>, x: Arrays<'_>) -> PyResult<Vec<Vec<(String, f64)>>> {
        let name = |(at, series)| {
            let trial = Trial::of_series(TrialKey::new("", "", 1), self.source.clone(), series);
            let ranking = self.model.rank_trial(trial);
            let ranking =
                ranking.map_err(|why| format!("series {at} of X (counted from 0): {why}"))?;
            let probabilities = ranking.probabilities();
            Ok(ranking.ranked.into_iter().map(|one| one.surface).zip(probabilities).collect())
        };
        let queries = series(&x, self.rate_hz)?;
        let named: Result<_, String> =
            py.detach(|| queries.into_par_iter().enumerate().map(name).collect());
        named.map_err(refused)
    }

    /// How long to scan in seconds, and why there is no time, or only that of whole recordings.
    fn scan_time(&self, py: Python<'_>, accuracy: Option<f64>) -> (Option<f64>, Option<String>) {
        let time = py.detach(|| self.model.clone().scan_time(accuracy));
        time.map_or((None, None), |time| (time.scan_s(), time.reason()))
    }
}

/// T* in seconds of recordings of one surface, or why there is none.
#[pyfunction]
fn t_star(py: Python<'_>, x: Arrays<'_>, about: About) -> PyResult<(Option<f64>, Option<String>)> {
    let (_, library) = library(&x, &about)?;
    let report = py.detach(|| report(&library, &Question::default(), |_, _| ()));
    let mut rows = report.map_err(refused)?.durations;
    Ok(rows.pop().map_or((None, None), |row| (row.t_star_s, row.reason)))
}

#[pyfunction]
fn hsic(
    py: Python<'_>,
    x: PyReadonlyArray2<'_, f64>,
    y: PyReadonlyArray2<'_, f64>,
    alpha: f64,
    permutations: Option<usize>,
    seed: u64,
) -> PyResult<(f64, f64, f64, f64, f64)> {
    let (x, y) = (x.as_array().to_owned(), y.as_array().to_owned());
    let threshold = permutations.map_or(Threshold::Gamma, Threshold::Permutations);
    let mut rng = seed::rng(seed, &[b"dependence"]);
    let found = py.detach(|| test_independence(x.view(), y.view(), alpha, threshold, &mut rng));
    let Dependence { sigma_x, sigma_y, hsic, kappa, p_value, .. } = found.map_err(refused)?;
    Ok((hsic, kappa, p_value, sigma_x, sigma_y))
}

#[pyfunction]
fn mmd(
    py: Python<'_>,
    z: PyReadonlyArray2<'_, f64>,
    y: PyReadonlyArray2<'_, f64>,
    sigma: Option<f64>,
) -> f64 {
    let (z, y) = (z.as_array().to_owned(), y.as_array().to_owned());
    py.detach(|| score_samples(z.view(), y.view(), false, sigma)).mmd2
}

/// The arrays, surfaces, users, rate and band of a library's source.
type Read<'py> =
    (Vec<Bound<'py, PyArray2<f32>>>, Vec<String>, Vec<String>, f64, Option<(f64, f64)>);

#[pyfunction]
fn read_library<'py>(
    py: Python<'py>,
    path: PathBuf,
    source: Option<String>,
) -> PyResult<Read<'py>> {
    let library = py.detach(|| dataset::open(&path, &Scene::lmt108())).map_err(refused)?;
    let outlines = library.entries.iter().map(Entry::outlines).collect::<Result<Vec<_>, _>>();
    let outlines = outlines.map_err(refused)?;
    let mut known: Vec<&SourceId> = outlines.iter().flat_map(|of| of.keys()).collect();
    known.sort();
    known.dedup();
    let chosen = match source {
        Some(name) => known.iter().find(|id| id.as_str() == name),
        None => known.first().filter(|_| known.len() == 1),
    };
    let names = || known.iter().map(|id| id.as_str()).collect::<Vec<_>>().join(", ");
    let source = *chosen.ok_or_else(|| {
        refused(format!("choose a series by source=NAME; there are: {}", names()))
    })?;
    let wanted = library.scene.clone().only(std::slice::from_ref(source)).map_err(refused)?;
    let entries = library.entries.iter().cloned().map(|entry| entry.within(&wanted));
    let entries: Vec<Entry> = entries.filter(|entry| !entry.sources.is_empty()).collect();
    let trials: Result<Vec<Trial>, _> = py.detach(|| entries.par_iter().map(Entry::load).collect());
    let (mut x, mut surfaces, mut users, mut rates) = (vec![], vec![], vec![], vec![]);
    for mut trial in trials.map_err(refused)? {
        if let Some(Signal::Series(series)) = trial.signals.remove(source) {
            x.push(series.view().t().as_standard_layout().into_owned().into_pyarray(py));
            rates.push(series.rate_hz());
            surfaces.push(trial.key.surface);
            users.push(trial.key.user);
        }
    }
    if let Some(other) = rates.iter().find(|rate| **rate != rates[0]) {
        let found = format!("source `{source}` has recordings of {} and of {other} Hz", rates[0]);
        return Err(refused(format!("{found}; resample them to one rate")));
    }
    let band_hz = wanted.get(source.as_str()).and_then(|spec| spec.domain.band_hz());
    Ok((x, surfaces, users, rates[0], band_hz))
}

#[pyfunction]
fn write_library(py: Python<'_>, path: PathBuf, x: Arrays<'_>, about: About) -> PyResult<()> {
    let (_, library) = library(&x, &about)?;
    if path.exists() {
        let problem = "exists already; choose another folder, or remove it";
        return Err(refused(format!("{} {problem}", path.display())));
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let options = TrialOptions { durable: false, ..TrialOptions::default() };
    let write = || {
        write_library_toml(&path, &library.scene, &name, false)?;
        let write = |entry: &Entry| write_trial(&path, &entry.load()?, &library.scene, &options);
        library.entries.iter().try_for_each(|entry| write(entry).map(drop))
    };
    py.detach(write).map_err(refused)
}

#[pymodule]
mod _core {
    #[pymodule_export]
    use super::{Model, hsic, mmd, read_library, t_star, write_library};
    use pyo3::prelude::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
