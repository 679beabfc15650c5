"""Kernel statistics, and how long a scan must last."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_array

from . import _core
from ._arrays import Band, about, as_series
from ._classifier import SurfaceClassifier


class Dependence(NamedTuple):
    """The result of a test of independence."""

    hsic: float
    """HSIC_b, the biased estimate."""
    kappa: float
    """The threshold at level alpha; a larger HSIC_b means dependence."""
    p_value: float
    """Probability of an HSIC_b at least this large if the sides are independent."""
    sigma_x: float
    """Length scale of the kernel on x, by the median heuristic."""
    sigma_y: float
    """Length scale of the kernel on y."""


def _samples(x: ArrayLike, name: str) -> NDArray[np.float64]:
    x = np.asarray(x)
    return check_array(x[:, np.newaxis] if x.ndim == 1 else x, dtype=np.float64, input_name=name)


def _or_why(found: tuple[float | None, str | None]) -> float | None:
    value, why = found
    if why:
        warnings.warn(why, stacklevel=3)
    return value


def hsic(
    x: ArrayLike, y: ArrayLike, *, alpha: float = 0.05, permutations: int | None = 1000, seed: int = 1,
) -> Dependence:
    """Tests whether paired samples depend on each other, as `surfaced dependence` does.

    x and y have shape (n, channels) or (n,), with n of at least 5. `permutations` of None computes the
    threshold and the p-value from exact moments of all permutations instead of random ones.

    Raises ValueError where the samples are no pairs, are constant or not finite, or the level `alpha` is
    not in (0, 0.5] or too small for so few permutations.
    """
    return Dependence(*_core.hsic(_samples(x, "x"), _samples(y, "y"), alpha, permutations, seed))


def mmd(z: ArrayLike, y: ArrayLike, *, sigma: float | None = None) -> float:
    """The biased estimate MMD²_b between samples z of a query and y of a library's trial.

    Both have shape (n, channels) or (n,), with the same channels. `sigma` is the length scale of the
    Gaussian kernel; None takes the median heuristic on z, as `surfaced compare --samples` does.

    Raises ValueError where samples are not finite, channels differ, or sigma is not positive.
    """
    z, y = _samples(z, "z"), _samples(y, "y")
    if z.shape[1] != y.shape[1]:
        raise ValueError(f"z has {z.shape[1]} channels, but y has {y.shape[1]}")
    if sigma is not None and not 0 < sigma < np.inf:
        raise ValueError(f"sigma is {sigma}; expected a positive number")
    return _core.mmd(z, y, sigma)


def t_star(X: Any, *, rate_hz: float) -> float | None:
    """T*: the least time in seconds between independent samples of recordings X of one surface.

    This is what `surfaced duration` finds for one source. Where there is none, such as where a signal
    repeats itself or recordings are too short, it is None, and a warning says why. One recording is
    enough; recordings of several people differ in loudness, which is no dependence in time.
    """
    series = as_series(X)
    return _or_why(_core.t_star(series, about(["surface"] * len(series), None, rate_hz, None)))


def required_scan_s(
    X: Any, y: ArrayLike, groups: ArrayLike | None = None, *, rate_hz: float, band_hz: Band = None,
    accuracy: float | None = None,
) -> float | None:
    """How long a scan must last to be named, in seconds, from recordings X of surfaces y.

    `accuracy` is the share of scans to name right, between 0 and 1; None allows to lose one percentage
    point against whole recordings. Recordings are left out and named after each of several times, as by
    `surfaced duration`: by people where `groups` names several. Where the answer is unknown, or only
    known to be no longer than whole recordings, a warning says why; unknown is None.
    """
    if accuracy is not None and not 0 < accuracy < 1:
        raise ValueError(f"accuracy is {accuracy}; expected a share between 0 and 1")
    classifier = SurfaceClassifier(rate_hz=rate_hz, band_hz=band_hz).fit(X, y, groups)
    return _or_why(classifier._model.scan_time(accuracy))
