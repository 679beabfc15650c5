"""Tests of the package. SURFACED_PROGRAM names the program that its answers are compared with."""

import json
import os
import pickle
import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest
import surfaced
from sklearn.base import clone
from sklearn.model_selection import GroupKFold, cross_val_score
from sklearn.utils.estimator_checks import check_estimator
from surfaced import SurfaceClassifier, _core
from surfaced._arrays import about, as_series

RATE_HZ = 1000.0
WIDTHS = {"felt": 9, "oak": 1, "steel": 3}
CONSTANT = "names rows of equal numbers, which say nothing of a drag and are refused"
EXPECTED_FAILURES = {
    "check_estimators_dtypes": CONSTANT,
    "check_classifier_data_not_an_array": CONSTANT,
}


def made(people=3, takes=3, samples=1500, channels=2):
    rng = np.random.default_rng(5)
    y = np.repeat(list(WIDTHS), people * takes)
    groups = np.tile(np.repeat([f"person {p}" for p in range(people)], takes), len(WIDTHS))
    drag = lambda name: np.convolve(rng.normal(size=samples), np.ones(WIDTHS[name]) / 3, "same")
    return np.array([[drag(name) for _ in range(channels)] for name in y]), y, groups


def program(*arguments):
    command = [os.environ["SURFACED_PROGRAM"], *map(str, arguments), "--json"]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


@pytest.fixture(scope="module")
def data():
    return made()


@pytest.fixture(scope="module")
def fitted(data):
    return SurfaceClassifier(rate_hz=RATE_HZ).fit(*data)


def test_scikit_learn_finds_an_estimator():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = check_estimator(
            SurfaceClassifier(), expected_failed_checks=EXPECTED_FAILURES, on_fail=None)
    failed = {one["check_name"]: one["exception"] for one in found if one["status"] == "failed"}
    assert not failed
    assert len(EXPECTED_FAILURES) <= 8
    assert {one["check_name"] for one in found if one["status"] == "xfail"} == set(EXPECTED_FAILURES)


def test_the_version_is_that_of_the_program():
    told = subprocess.check_output([os.environ["SURFACED_PROGRAM"], "--version"], text=True)
    assert told.split()[1] == surfaced.__version__


def test_people_are_left_out(data):
    X, y, groups = data
    scores = cross_val_score(
        SurfaceClassifier(rate_hz=RATE_HZ), X, y, groups=groups, cv=GroupKFold(3),
        params={"groups": groups}, error_score="raise")
    assert scores.mean() > 0.9


@pytest.mark.parametrize("band_hz", [None, (20.0, 200.0)])
def test_answers_are_those_of_the_program(tmp_path, band_hz):
    X, y, groups = made(samples=200)
    X = X + np.random.default_rng(1).normal(size=X.shape)  # So that answers are in doubt.
    surfaced.write_library(tmp_path / "made", X, y, groups, rate_hz=RATE_HZ, band_hz=band_hz)
    answers = program("eval", tmp_path / "made", "--protocol", "all-vs-one-user")["predictions"]
    assert len(answers) == len(X)
    for person in np.unique(groups):
        asked = [one for one in answers if one["user"] == person]
        others = groups != person
        classifier = SurfaceClassifier(rate_hz=RATE_HZ, band_hz=band_hz)
        classifier.fit(X[others], y[others], groups[others])
        ours = classifier.predict_proba(X[[one["trial"] - 1 for one in asked]])
        theirs = [[one["probabilities"][name] for name in classifier.classes_] for one in asked]
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)
        assert ours.max(axis=1).min() < 0.7


def test_scan_times_are_those_of_the_program(tmp_path, data):
    X, y, groups = data
    surfaced.write_library(tmp_path / "made", X, y, groups, rate_hz=RATE_HZ)
    report = program("duration", tmp_path / "made", "--accuracy", 0.6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = surfaced.required_scan_s(X, y, groups, rate_hz=RATE_HZ, accuracy=0.6)
    assert found is not None and found == pytest.approx(report["answer"]["scan_s"])
    one = (y == "felt") & (groups == "person 0")
    row = next(row for row in report["durations"] if row["surface"] == "felt")
    assert surfaced.t_star(X[one], rate_hz=RATE_HZ) == pytest.approx(row["t_star_s"])
    with pytest.warns(UserWarning, match="changes|constant"):
        assert surfaced.t_star(np.ones((3, 500)), rate_hz=RATE_HZ) is None


def test_statistics_are_those_of_the_program(tmp_path):
    rng = np.random.default_rng(2)
    x = rng.normal(size=(60, 2))
    y = x[:, :1] ** 2 + 0.1 * rng.normal(size=(60, 1))
    for name, samples in {"x": x, "y": y, "z": x + 0.5}.items():
        np.savetxt(tmp_path / f"{name}.csv", samples, delimiter=",", fmt="%.17g")
    theirs = program("dependence", tmp_path / "x.csv", tmp_path / "y.csv")
    ours = surfaced.hsic(x, y)._asdict()
    assert ours == pytest.approx({key: theirs[key] for key in ours})
    assert ours["hsic"] > ours["kappa"]
    theirs = program("compare", "--samples", tmp_path / "z.csv", tmp_path / "x.csv")
    assert surfaced.mmd(x + 0.5, x) == pytest.approx(theirs["mmd2"])


def test_a_library_is_read_as_it_was_written(tmp_path, data):
    X, y, groups = data
    lengths = [900 + at for at in range(len(X))]
    uneven = [one[:, :length].astype("f4") for one, length in zip(X, lengths)]
    surfaced.write_library(
        tmp_path / "made", uneven, y, groups, rate_hz=250, band_hz=(1, 90), source="tip")
    read = surfaced.read_library(tmp_path / "made")
    assert (read.rate_hz, read.band_hz) == (250, (1, 90))
    assert sorted(zip(read.y, read.groups)) == sorted(zip(y, groups))
    as_bytes = lambda series: sorted(one.tobytes() for one in series)
    assert as_bytes(read.X) == as_bytes(uneven)
    with pytest.raises(ValueError, match="there are: tip"):
        surfaced.read_library(tmp_path / "made", source="mi2")
    with pytest.raises(ValueError, match="exists already"):
        surfaced.write_library(tmp_path / "made", X, y, rate_hz=250)
    with pytest.raises(ValueError, match="use letters"):
        surfaced.write_library(tmp_path / "odd", X, y, rate_hz=250, source="a/b")


def test_one_channel_has_many_forms(data):
    X, y, groups = data
    first = X[:, 0]
    forms = [first, first[:, np.newaxis], first.astype("f4"), list(first), np.asfortranarray(first)]
    classifier = SurfaceClassifier(rate_hz=RATE_HZ).fit(first, y, groups)
    expected = classifier.predict_proba(first)
    for form in forms:
        np.testing.assert_array_equal(classifier.predict_proba(form), expected)
    np.testing.assert_allclose(expected.sum(axis=1), 1)
    uneven = [one[: 1000 + 7 * at] for at, one in enumerate(first)]
    assert SurfaceClassifier(rate_hz=RATE_HZ).fit(uneven, y, groups).score(uneven, y) > 0.9


def test_copies_answer_alike(tmp_path, data, fitted):
    X, y, _ = data
    expected = fitted.predict_proba(X)
    surfaced.save(fitted, tmp_path / "model")
    for copy in [pickle.loads(pickle.dumps(fitted)), surfaced.load(tmp_path / "model")]:
        np.testing.assert_array_equal(copy.predict_proba(X), expected)
        assert copy.get_params() == fitted.get_params()
        assert copy.score(X, y) > 0.9
    assert not hasattr(clone(fitted), "classes_")


def test_python_goes_on_while_a_model_is_fitted(data):
    X, y, _ = data
    series, of = as_series(X), about(list(y), None, RATE_HZ, None)
    ticks, done = [], threading.Event()

    def tick():
        while not done.wait(0.001):
            ticks.append(1)

    other, interval = threading.Thread(target=tick), sys.getswitchinterval()
    sys.setswitchinterval(100)  # So that nobody but the fit itself lets the other thread go on.
    other.start()
    ticks.clear()
    _core.Model(series, of, 1)
    ticked = len(ticks)
    sys.setswitchinterval(interval)
    done.set()
    other.join()
    assert ticked > 0


def test_a_damaged_model_is_refused(tmp_path, fitted):
    surfaced.save(fitted, tmp_path / "model")
    whole = (tmp_path / "model").read_bytes()
    altered = bytearray(whole)
    altered[len(whole) // 2] ^= 0xFF
    pickled = pickle.dumps(fitted)
    for at, damaged in enumerate([b"", whole[: len(whole) // 2], altered, pickled, b"hello"]):
        (tmp_path / "model").write_bytes(damaged)
        with pytest.raises(ValueError, match="model is no whole file"):
            surfaced.load(tmp_path / "model"), at


BAD = {
    "NaN": lambda X: np.where(X == X[0, 0, 0], np.nan, X),
    "infinity": lambda X: np.where(X == X[0, 0, 0], np.inf, X),
    "channel 1 is inf at sample 1": lambda X: np.where(X == X[0, 0, 0], 1e300, X),
    "0 sample": lambda X: X[:0],
    "too short": lambda X: X[:, :, :1],
    "no samples|has 0 channels": lambda X: X[:, :0],
    "4 dimensions": lambda X: X[np.newaxis],
    "Expected 2D array": lambda X: X[0, 0],
    "could not convert": lambda X: np.full(X.shape, "oak"),
    "series 1 of X .* has 1 channels": lambda X: [X[0], X[1, :1], *X[2:]],
}


@pytest.mark.parametrize("why", BAD)
def test_bad_recordings_are_refused(data, fitted, why):
    X, y, _ = data
    bad = BAD[why](X)
    with pytest.raises(ValueError, match=why):
        fitted.predict(bad)
    with pytest.raises(ValueError, match=why):
        SurfaceClassifier(rate_hz=RATE_HZ).fit(bad, y[: len(bad)])


def test_bad_labels_and_settings_are_refused(data, fitted):
    X, y, groups = data
    for arguments, settings, why in [
        ((X, ["oak"] * len(X)), {}, "one class"),
        ((X, y[:-1]), {}, "inconsistent numbers"),
        ((X, y, groups[:-1]), {}, "inconsistent numbers"),
        ((X, y), {"rate_hz": 0}, "sample rate of 0"),
        ((X, y), {"rate_hz": np.nan}, "sample rate of NaN"),
        ((X, y), {"band_hz": (10, 900)}, "above half"),
        ((X, y), {"band_hz": (90, 10)}, "low < high"),
        ((X, y), {"band_hz": (1, 2, 3)}, "too many values"),
    ]:
        with pytest.raises(ValueError, match=why):
            SurfaceClassifier(**settings).fit(*arguments)
    with pytest.raises(ValueError, match="1 channels, but SurfaceClassifier was fitted to 2"):
        fitted.predict(X[:, :1])
    for says_nothing in [np.ones_like(X[0]), X[1, :, :9]]:
        with pytest.raises(ValueError, match="series 1 of X .*: too little to name"):
            fitted.predict([X[0], says_nothing])
