"""Arrays as recordings, and recordings as arrays."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_array
from sklearn.utils.validation import check_consistent_length

from . import _core

Series = list[NDArray[np.float32]]
Band = tuple[float, float] | None

# Samples of the shortest frame. A series of two or three, as in tables of features, goes on with its last
# value up to there; a single sample says nothing of a drag.
FRAME = 4
# The person of recordings that name none, as in libraries on disk.
NOBODY = "expert"


def as_series(X: Any, estimator: Any = None) -> Series:
    """The recordings of X as arrays of shape (channels, samples), all of as many channels."""
    if isinstance(X, (list, tuple)) and len({_shape(one) for one in X}) > 1:
        several = [_checked(_shaped(one), estimator) for one in X]
    else:
        X = _checked(X, estimator)
        several = list(X[:, np.newaxis] if X.ndim == 2 else X)
        if X.ndim > 3:
            raise ValueError(f"X has {X.ndim} dimensions; expected (n, channels, samples) or (n, samples)")
    for at, one in enumerate(several):
        if len(one) != len(several[0]):
            raise ValueError(
                f"series {at} of X (counted from 0) has {len(one)} channels, but series 0 has "
                f"{len(several[0])}")
        if one.shape[1] < 2:
            raise ValueError(
                f"series {at} of X (counted from 0) is too short (n_features={one.shape[1]}); expected "
                "two samples or more")
    with np.errstate(over="ignore"):  # What becomes infinite is refused as such.
        return [np.ascontiguousarray(_long_enough(one), dtype=np.float32) for one in several]


def _long_enough(one: NDArray[Any]) -> NDArray[Any]:
    lacking = FRAME - one.shape[1]
    return np.pad(one, ((0, 0), (0, lacking)), mode="edge") if lacking > 0 else one


def columns_of(X: Any) -> int | None:
    """The columns of a table; None for series of several channels, or of unequal lengths."""
    shapes = {_shape(one) for one in X} if isinstance(X, (list, tuple)) else {_shape(X)[1:]}
    shape = shapes.pop() if len(shapes) == 1 else ()
    return shape[0] if len(shape) == 1 else None


def _shape(of: Any) -> tuple[int, ...]:
    return tuple(of.shape) if hasattr(of, "shape") else np.asarray(of).shape


def _shaped(one: Any) -> Any:
    return np.asarray(one)[np.newaxis] if len(_shape(one)) == 1 else one


def _checked(X: Any, estimator: Any) -> NDArray[Any]:
    return check_array(
        X, allow_nd=True, dtype=[np.float32, np.float64], estimator=estimator, input_name="X")


def about(
    labels: Sequence[str], groups: ArrayLike | None, rate_hz: float, band_hz: Band, source: str = "signal",
) -> dict[str, Any]:
    """How recordings came about, for the Rust core."""
    users = [NOBODY] * len(labels) if groups is None else [str(group) for group in np.asarray(groups)]
    check_consistent_length(labels, users)
    if band_hz is not None:
        low_hz, high_hz = band_hz
        band_hz = float(low_hz), float(high_hz)
    return {
        "labels": list(labels), "users": users, "source": source, "rate_hz": float(rate_hz),
        "band_hz": band_hz,
    }


class Recordings(NamedTuple):
    """The recordings of one source of a library."""

    X: NDArray[np.float32] | Series
    """Shape (n, channels, samples) where all are equally long; else a list of (channels, samples)."""
    y: NDArray[np.str_]
    """The surface of each recording, shape (n,)."""
    groups: NDArray[np.str_]
    """The person of each recording, shape (n,); `expert` where the library names none."""
    rate_hz: float
    """Samples a second."""
    band_hz: Band
    """The lowest and the highest frequency to compare, in Hz; None where the library says nothing."""


def read_library(path: str | os.PathLike[str], source: str | None = None) -> Recordings:
    """Reads the recordings of one source of a library, or of any folder that the program can read.

    `source` may be left out where the library has one series only. Pictures are not read. Raises
    ValueError where a file cannot be used, where the library has no such series, and where its
    recordings differ in rate.
    """
    x, surfaces, users, rate_hz, band_hz = _core.read_library(os.fspath(path), source)
    X = np.stack(x) if len({one.shape for one in x}) == 1 else x
    return Recordings(X, np.array(surfaces), np.array(users), rate_hz, band_hz)


def write_library(
    path: str | os.PathLike[str], X: Any, y: ArrayLike, groups: ArrayLike | None = None, *,
    rate_hz: float, band_hz: Band = None, source: str = "signal",
) -> None:
    """Writes recordings as a new library, which the program `surfaced` reads.

    `y` holds the surface of each recording and `groups` the person, both as text of shape (n,);
    `source` names the sensor: letters, digits, `_` and `-`. Nothing is lost but what float32 cannot
    hold. Raises ValueError where the folder exists, or a name cannot be the name of a folder.
    """
    series = as_series(X)
    surfaces = [str(surface) for surface in np.asarray(y)]
    check_consistent_length(series, surfaces)
    _core.write_library(os.fspath(path), series, about(surfaces, groups, rate_hz, band_hz, source))
