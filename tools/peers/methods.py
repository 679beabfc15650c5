"""The peers. Each turns a signal into features, learns from a library's, and names one query.

Settings are those of the papers or of the packages, or round numbers: none was tuned.
"""

import numpy as np
from aeon.transformations.collection.convolution_based import MiniRocket as MiniRocketTransform
from scipy import fft, signal
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.linear_model import RidgeClassifierCV
from sklearn.preprocessing import StandardScaler

from hydra import Hydra, SparseScaler
from mmd import Mmd, amplitudes

SERIES_RATE_HZ = 14_700  # what MiniRocket and Hydra see: the drag sound's band is 7500 Hz


class Method:
    """One peer. `features` does not depend on the fold's library, so that they can be computed
    once for many folds; a query pays for `features` and for `predict`."""

    name: str
    setting: str
    windows = True  # a short query is compared with windows of its length; else with first ones
    pretrained = False  # `features` needs some unlabelled library signals first

    def prepare(self, rate_hz: int, length: int) -> None:
        """What signals will look like."""
        self.rate_hz = rate_hz

    def pretrain(self, signals: list[np.ndarray]) -> None:
        """What `features` learns, from signals that are in the library of every fold served."""

    def features(self, samples: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def fit(self, features: np.ndarray, labels: np.ndarray) -> None:
        """Learns from a library, features row by row; `labels` are class numbers, ascending."""
        raise NotImplementedError

    def predict(self, features: np.ndarray) -> int:
        raise NotImplementedError


class MmdMethod(Method):
    windows = False

    def __init__(self, repetitions: int, seed: int):
        self.name = "numpy-mmd"
        self.setting = f"n=400 R={repetitions} shift shared"
        self.repetitions = repetitions
        self.seed = seed

    def features(self, samples):
        return amplitudes(samples, self.rate_hz)

    def fit(self, features, labels):
        self.mmd = Mmd(features, self.repetitions, self.seed)
        self.labels = labels

    def predict(self, features):
        # argmin takes the first of equals: the smaller label, then the smaller trial
        return self.labels[np.argmin(self.mmd.scores(features))]


class Series(Method):
    """What MiniRocket and Hydra see: the signal thinned to about 14.7 kHz, its mean and scale
    taken out, as in the archive that both were made for."""

    def prepare(self, rate_hz, length):
        super().prepare(rate_hz, length)
        self.step = max(1, round(rate_hz / SERIES_RATE_HZ))
        self.length = -(-length // self.step)

    def series(self, samples):
        thinned = signal.resample_poly(samples, 1, self.step) if self.step > 1 else samples
        return ((thinned - thinned.mean()) / (thinned.std() + 1e-8)).astype(np.float32)

    def fit_ridge(self, features, labels, scaler):
        self.scaler = scaler.fit(features)
        self.ridge = RidgeClassifierCV(alphas=np.logspace(-3, 3, 10))
        self.ridge.fit(self.scaler.transform(features), labels)

    def predict_ridge(self, features):
        return self.ridge.predict(self.scaler.transform(features[None]))[0]


class MiniRocket(Series):
    """Dempster, Schmidt, Webb, "MiniRocket: a very fast (almost) deterministic transform for time
    series classification", KDD 2021, as in aeon. Its biases are quantiles of convolutions of a few
    random training series."""

    name = "minirocket"
    setting = "9996 features, 14.7 kHz, ridge"
    pretrained = True

    def __init__(self, seed: int):
        self.seed = seed

    def pretrain(self, signals):
        self.transform = MiniRocketTransform(n_kernels=10_000, random_state=self.seed, n_jobs=1)
        self.transform.fit(np.stack([self.series(samples) for samples in signals])[:, None, :])

    def features(self, samples):
        return self.transform.transform(self.series(samples)[None, None, :])[0]

    def fit(self, features, labels):
        self.fit_ridge(features, labels, StandardScaler())

    def predict(self, features):
        return self.predict_ridge(features)


class HydraMethod(Series):
    name = "hydra"
    setting = "k=8 g=64, 14.7 kHz, ridge"

    def __init__(self, seed: int):
        self.seed = seed

    def prepare(self, rate_hz, length):
        super().prepare(rate_hz, length)
        self.hydra = Hydra(self.length, self.seed)

    def features(self, samples):
        return self.hydra.transform(self.series(samples))

    def fit(self, features, labels):
        self.fit_ridge(features, labels, SparseScaler())

    def predict(self, features):
        return self.predict_ridge(features)


class LogBands(Method):
    """Mean and standard deviation over frames of the log energies of 40 bands from 0 to 7500 Hz,
    evenly spaced on the mel scale; Hann frames of 2048 points, half overlapping."""

    FRAME = 2048
    BANDS = 40
    BAND_HZ = 7500.0

    def prepare(self, rate_hz, length):
        super().prepare(rate_hz, length)
        if length < self.FRAME:
            raise ValueError(f"{length} samples; log bands need {self.FRAME} or more")
        self.window = np.hanning(self.FRAME + 1)[:-1].astype(np.float32)
        top_mel = np.log1p(min(self.BAND_HZ, rate_hz / 2) / 700)
        edges_hz = 700 * np.expm1(np.linspace(0, top_mel, self.BANDS + 1))
        edges = np.round(edges_hz * self.FRAME / rate_hz).astype(int)
        for i in range(1, len(edges)):  # one bin at least
            edges[i] = max(edges[i], edges[i - 1] + 1)
        self.edges = edges

    def features(self, samples):
        frames = np.lib.stride_tricks.sliding_window_view(samples, self.FRAME)
        frames = frames[:: self.FRAME // 2] * self.window
        power = np.abs(fft.rfft(frames, axis=1)[:, : self.edges[-1]]) ** 2
        widths = np.diff(self.edges)
        bands = np.log(np.add.reduceat(power, self.edges[:-1], axis=1) / widths + 1e-10)
        return np.concatenate([bands.mean(0), bands.std(0)])


class Lda(LogBands):
    name = "lda"
    setting = "log bands, Ledoit-Wolf shrinkage"

    def __init__(self, seed: int):
        """No randomness in it."""

    def fit(self, features, labels):
        self.model = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
        self.model.fit(features, labels)

    def predict(self, features):
        return self.model.predict(features[None])[0]


class ExtraTrees(LogBands):
    name = "extratrees"
    setting = "log bands, 500 trees"

    def __init__(self, seed: int):
        self.seed = seed

    def fit(self, features, labels):
        self.model = ExtraTreesClassifier(500, random_state=self.seed, n_jobs=1)
        self.model.fit(features, labels)

    def predict(self, features):
        return self.model.predict(features[None])[0]


METHODS = {
    "lda": Lda,
    "extratrees": ExtraTrees,
    "minirocket": MiniRocket,
    "hydra": HydraMethod,
    "mmd-1": lambda seed: MmdMethod(1, seed),
    "mmd-10": lambda seed: MmdMethod(10, seed),
}
