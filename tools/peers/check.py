"""Tests of the peers: each own implementation against a plain one, or against golden values.

    run --check [GOLDEN]     GOLDEN: the folder with mmd_cases.csv and spectrum_x.csv
"""

import csv
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.io import wavfile

import quant
from data import Trial, folds, load
from evaluation import interval, wilson
from hydra import Hydra, transform_plainly
from mmd import Mmd, amplitudes, sigma_of
from peers import POINT_KEYS, join


def hydra_agrees_with_plain_numpy() -> None:
    for channels in (1, 5):
        series = np.random.default_rng(0).standard_normal((channels, 3001)).astype(np.float32)
        hydra = Hydra(channels, 3001, seed=2)
        assert hydra.channels.shape[-1] == min(channels, 2)
        fast, plain = hydra.transform(series), transform_plainly(hydra, series)
        assert fast.shape == plain.shape == (9 * 2 * 32 * 8 * 2,)
        hard = np.abs(fast - plain).reshape(-1, 2)[:, 1]
        # responses that f32 cannot tell apart may change sides
        assert hard.max() <= 1, hard.max()
        np.testing.assert_allclose(fast, plain, rtol=1e-3, atol=1.5)


def quant_agrees_with_plain_loops() -> None:
    for length in (7, 50, 138, 501):
        series = np.random.default_rng(length).standard_normal((3, length)).astype(np.float32)
        fast, plain = quant.transform(series), quant.transform_plainly(series.astype(np.float64))
        np.testing.assert_allclose(fast, plain, rtol=1e-4, atol=1e-4)
    # 2^(depth − 1) · 4 − 2 − depth intervals
    assert len(quant.intervals(512)) == 120


def mmd_agrees_with_the_plain_sums() -> None:
    rng = np.random.default_rng(1)
    library, query = rng.gamma(2, 1e-4, (3, 5000)), rng.gamma(1.9, 1e-4, 5000)
    mmd = Mmd(library, 2, seed=3)
    expected = np.zeros(3)
    for at in mmd.positions:
        for i, y in enumerate(library[:, at]):
            expected[i] += plain_score(y, query[at], shift=True) / 2
    assert np.abs(mmd.scores(query) - expected).max() < 1e-3


def plain_score(y: np.ndarray, z: np.ndarray, shift: bool) -> float:
    z = z + y.mean() - z.mean() if shift else z
    sigma = sigma_of(z)

    def mean(a, b):
        return np.exp(-((a[:, None] - b[None]) ** 2) / (2 * sigma**2)).mean()

    return len(z) * (mean(y, y) + mean(z, z) - 2 * mean(y, z))


def golden_values_are_reproduced(golden: Path) -> None:
    used = 0
    with open(golden / "mmd_cases.csv", encoding="utf-8") as file:
        for case in csv.DictReader(file):
            if case["dims"] != "1":
                continue
            y, z = (np.loadtxt(golden / f"mmd_{case['case']}_{side}.csv") for side in "yz")
            score, shift = float(case["score_m_mmd2"]), case["shift"] == "1"
            np.testing.assert_allclose(sigma_of(z), float(case["sigma"]), rtol=1e-9)
            np.testing.assert_allclose(plain_score(y, z, shift), score, rtol=1e-9)
            if shift and len(z) == 400:
                mmd = Mmd(y[None], 1, seed=0)
                mmd.positions = [np.arange(400)]
                mmd.samples = [(y - y.mean())[None]]
                assert abs(mmd.scores(z)[0] - score) < 1e-3
            used += 1
    assert used > 0, "no case of one channel"
    found = amplitudes(np.loadtxt(golden / "spectrum_x.csv"), 44_100)
    np.testing.assert_allclose(found, np.loadtxt(golden / "spectrum_amp_0_7500Hz.csv"), rtol=1e-9)


def a_recorded_library_is_read() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for surface in ("cork", "felt"):
            for number in (1, 2, 3):
                trial = Path(folder) / surface / f"trial{number}"
                trial.mkdir(parents=True)
                wavfile.write(trial / "mi2.wav", 44_100, np.full(9, 16384, np.int16))
                wavfile.write(trial / "ac.wav", 1000, np.arange(6, dtype=np.float32).reshape(3, 2))
        (trial / "trial.toml").write_text('user = "user1"\n', encoding="utf-8")
        data = load(Path(folder))
    assert (data.sources, data.rates_hz) == (["ac", "mi2"], [1000, 44_100])
    assert [(t.surface, t.user, t.number) for t in data.trials] == [
        ("cork", "expert", 1), ("cork", "expert", 2), ("cork", "expert", 3),
        ("felt", "expert", 1), ("felt", "expert", 2), ("felt", "user1", 3),
    ]
    ac, mi2 = data.trials[0].signals
    assert (mi2 == 0.5).all() and mi2.shape == (1, 9)
    np.testing.assert_array_equal(ac, [[0, 2, 4], [1, 3, 5]])
    assert [(f.library, f.queries) for f in folds(data.trials)] == [
        ([1, 2, 4], [0, 3]), ([0, 2, 3], [1, 4]), ([0, 1, 3, 4], [2]),
    ]
    (fold,) = folds(data.trials, "expert-vs-users")
    assert (fold.name, fold.library, fold.queries) == ("user1", [0, 1, 2, 3, 4], [5])
    pairs = [(user, surface) for user in ("expert", "user1") for surface in ("cork", "felt")]
    trials = [Trial(surface, user, 1, Path(), []) for user, surface in pairs]
    assert [(f.name, f.library, f.queries) for f in folds(trials, "all-vs-one-user")] == [
        ("expert", [2, 3], [0, 1]), ("user1", [0, 1], [2, 3]),
    ]


def wilson_interval_is_the_known_one() -> None:
    np.testing.assert_allclose(wilson(1.0, 10), (0.7224672, 1.0), atol=1e-6)
    np.testing.assert_allclose(wilson(0.5, 10), (0.2365931, 0.7634069), atol=1e-6)


def intervals_are_over_users_from_three_on() -> None:
    users = [{"accuracy": a, "queries": 10} for a in (0.2, 0.4, 0.5, 0.6, 0.8)]
    effect = 0.05 / 5 / (0.25 / 50)  # variance between users over that of 50 queries
    equivalent = 50 / effect * (1.9599640 / 2.7764451) ** 2
    np.testing.assert_allclose(interval(25, 50, users), wilson(0.5, equivalent), atol=1e-6)
    assert interval(10, 20, users[:2]) == wilson(0.5, 20)


def joining_a_chart_twice_changes_nothing() -> None:
    ours = {"method": "svm", "setting": "", "query_seconds": None}
    result = dict.fromkeys((*POINT_KEYS, "query_cpu_ms_p50", "query_cpu_ms_p99"), 0)
    result |= {"method": "lda", "setting": "", "query_seconds": None}
    chart = {"points": [ours], "other": 1}
    join(chart, [result])
    join(chart, [result])
    assert chart["points"][0] is ours and len(chart["points"]) == 2 and chart["other"] == 1


CHECKS = (
    hydra_agrees_with_plain_numpy,
    quant_agrees_with_plain_loops,
    mmd_agrees_with_the_plain_sums,
    a_recorded_library_is_read,
    wilson_interval_is_the_known_one,
    intervals_are_over_users_from_three_on,
    joining_a_chart_twice_changes_nothing,
)

if __name__ == "__main__":
    for check in CHECKS:
        check()
        print(f"{check.__name__}: holds")
    if len(sys.argv) > 1:
        golden_values_are_reproduced(Path(sys.argv[1]))
        print("golden_values_are_reproduced: holds")
    else:
        print("golden_values_are_reproduced: skipped, no folder given")
