"""The classifier, for scikit-learn."""

from __future__ import annotations

import json
import os
import zipfile
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_consistent_length, check_is_fitted, column_or_1d

from . import _core
from ._arrays import Band, Series, about, as_series, columns_of

# Of the files that `save` writes.
FORMAT = 1


class SurfaceClassifier(ClassifierMixin, BaseEstimator):
    """Names surfaces by kernel mean embeddings and shrinkage discriminants.

    This is the method `embedding` of the program `surfaced`, with the same answers for recordings of
    one sensor. Recordings may differ in length, also from those of `fit`, but not in channels.

    Parameters
    ----------
    rate_hz : float
        Samples a second, of all recordings.
    band_hz : (float, float) or None
        The lowest and the highest frequency to compare, in Hz. None compares up to 500 Hz or half of
        `rate_hz`, whichever is lower.
    seed : int
        Of the altered copies of recordings that the model also learns from.

    Attributes
    ----------
    classes_ : array of shape (n_classes,)
        The values in y, sorted.
    n_features_in_ : int
        The size of the second axis of X: channels, or samples where X has two axes.

    A pickle and a file of `save` hold the recordings and labels, not the model. Reading one fits the
    model again, which gives the same answers and takes as long as `fit`.
    """

    def __init__(self, rate_hz: float = 1000.0, band_hz: Band = None, seed: int = 1) -> None:
        self.rate_hz = rate_hz
        self.band_hz = band_hz
        self.seed = seed

    def fit(self, X: Any, y: ArrayLike, groups: ArrayLike | None = None) -> SurfaceClassifier:
        """Fits a model to recordings X of surfaces y, shape (n,).

        `groups`, shape (n,), says who made each recording. Where there are several people, the model
        leaves out each of them in turn to find how sure it may be of people that it has not met.

        Raises ValueError where X or y cannot be used, or y holds a single class.
        """
        if y is None:
            raise ValueError("SurfaceClassifier requires y to be passed, but the target y is None")
        series = as_series(X, self)
        y = column_or_1d(y, warn=True)
        check_consistent_length(series, y)
        check_classification_targets(y)
        classes, labels = np.unique(y, return_inverse=True)
        if len(classes) < 2:
            raise ValueError(f"y holds one class, {classes[0]!r}; expected two classes or more")
        people = None
        if groups is not None:
            people = np.unique(column_or_1d(groups), return_inverse=True)[1]
            check_consistent_length(series, people)
        self._learn(series, labels, people)
        self.classes_ = classes
        self._columns = columns_of(X)
        self.n_features_in_ = self._columns or len(series[0])
        return self

    def _learn(self, series: Series, labels: NDArray[Any], people: NDArray[Any] | None) -> None:
        of = about([str(label) for label in labels], people, self.rate_hz, self.band_hz)
        self._model = _core.Model(series, of, self.seed)
        self._learnt = (series, labels, people)

    def predict_proba(self, X: Any) -> NDArray[np.float64]:
        """The probability of each class of `classes_` for each recording: shape (n, n_classes).

        Raises ValueError where X cannot be used, or a recording is constant and so says nothing.
        """
        check_is_fitted(self)
        # As in every estimator, a row of a table has the columns of `fit`.
        columns = None if isinstance(X, (list, tuple)) else columns_of(X)
        if columns and self._columns and columns != self._columns:
            raise ValueError(
                f"X has {columns} features, but SurfaceClassifier is expecting {self._columns} features "
                "as input; put recordings of another length into a list")
        series, channels = as_series(X, self), len(self._learnt[0][0])
        if len(series[0]) != channels:
            raise ValueError(
                f"X has {len(series[0])} channels, but SurfaceClassifier was fitted to {channels}")
        probabilities = np.zeros((len(series), len(self.classes_)))
        for row, ranked in zip(probabilities, self._model.rank(series)):
            for label, probability in ranked:
                row[int(label)] = probability
        return probabilities

    def predict(self, X: Any) -> NDArray[Any]:
        """The most probable class of each recording: shape (n,). Raises as `predict_proba` does."""
        best = np.argmax(self.predict_proba(X), axis=1)
        return self.classes_[best]

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.three_d_array = True
        return tags

    def __getstate__(self) -> dict[str, Any]:
        state = dict(super().__getstate__())
        state.pop("_model", None)
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if "_learnt" in state:
            self._learn(*self._learnt)


def save(classifier: SurfaceClassifier, path: str | os.PathLike[str]) -> None:
    """Writes a fitted classifier to a file that later versions read as well, and that runs no code.

    It is a NumPy archive (.npz) of the parameters, the recordings as float32, their labels and groups.
    """
    check_is_fitted(classifier)
    series, labels, people = classifier._learnt
    classes = classifier.classes_
    if classes.dtype == object:
        classes = np.array([str(name) for name in classes])
    parameters = json.dumps(classifier.get_params(), default=lambda number: number.item())
    with open(path, "wb") as file:
        np.savez(
            file, surfaced_format=FORMAT, parameters=parameters,
            samples=np.concatenate(series, axis=1), lengths=[one.shape[1] for one in series],
            y=classes[labels], groups=[] if people is None else people)


def load(path: str | os.PathLike[str]) -> SurfaceClassifier:
    """Reads a file of `save`, and fits the classifier again.

    Raises ValueError where the file is no such file, is damaged, or was written by a later version.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            if file["surfaced_format"] != FORMAT:
                raise ValueError(f"format {file['surfaced_format']}, not {FORMAT}; update surfaced")
            samples, lengths, y, groups = (file[key] for key in ("samples", "lengths", "y", "groups"))
            classifier = SurfaceClassifier(**json.loads(str(file["parameters"])))
        series = np.split(samples, np.cumsum(lengths)[:-1], axis=1)
        return classifier.fit(series, y, groups if len(groups) else None)
    except (ValueError, TypeError, KeyError, AttributeError, EOFError, zipfile.BadZipFile) as why:
        raise ValueError(f"{os.fspath(path)} is no whole file of surfaced.save: {why}") from why
