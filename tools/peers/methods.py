"""The peers. Each turns a signal into features, learns from a library's, and names one query.

Settings are those of the papers or of the packages, or round numbers: none was tuned.
"""

import numpy as np
from aeon.transformations.collection.convolution_based import MiniRocket as MiniRocketTransform
from aeon.transformations.collection.convolution_based import MultiRocket as MultiRocketTransform
from scipy import fft, signal
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.linear_model import RidgeClassifierCV
from sklearn.preprocessing import StandardScaler

import quant
from data import Signals
from hydra import Hydra, SparseScaler
from mmd import Mmd, amplitudes

SERIES_RATE_HZ = 14_700  # what the convolutions see at most: the drag sound's band is 7500 Hz


class Method:
    """One peer. `features` does not depend on the fold's library, so that they can be computed
    once for many folds; a query pays for `features` and for `predict`."""

    name: str
    setting: str
    windows = True  # a short query is compared with windows of its length; else with first ones
    pretrained = False  # `features` needs some unlabelled library signals first

    def prepare(self, rates_hz: list[int], lengths: np.ndarray) -> None:
        """What signals will look like; `lengths` in samples, shape (trials, sources)."""

    def pretrain(self, trials: list[Signals]) -> None:
        """What `features` learns, from trials that are in the library of every fold served."""

    def features(self, signals: Signals) -> np.ndarray:
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

    def prepare(self, rates_hz, lengths):
        if len(rates_hz) != 1:
            raise ValueError("numpy-mmd compares one source of one channel")
        self.rate_hz, self.length = rates_hz[0], lengths.min()

    def features(self, signals):
        (series,) = signals[0]
        return amplitudes(series[: self.length], self.rate_hz)

    def fit(self, features, labels):
        self.mmd = Mmd(features, self.repetitions, self.seed)
        self.labels = labels

    def predict(self, features):
        # argmin takes the first of equals: the smaller label, then the smaller trial
        return self.labels[np.argmin(self.mmd.scores(features))]


def median_length(lengths: np.ndarray) -> int:
    return int(np.median(lengths))


def at_length(series: np.ndarray, length: int) -> np.ndarray:
    """Series of shape (channels, samples), interpolated linearly to one length."""
    if series.shape[1] == length:
        return series
    at = np.linspace(0, series.shape[1] - 1, length)
    held = np.arange(series.shape[1])
    return np.stack([np.interp(at, held, channel) for channel in series]).astype(np.float32)


def normalised(series: np.ndarray) -> np.ndarray:
    """Channels without their mean and scale, as the series of the UCR archive are."""
    centred = series - series.mean(1, keepdims=True)
    return (centred / (series.std(1, keepdims=True) + 1e-8)).astype(np.float32)


class Series(Method):
    """What convolutions see: every channel of every source at one length, which is the longest
    source's median, its mean and scale taken out, as in the archives that they were made for.
    Sounds are thinned to about 14.7 kHz."""

    def prepare(self, rates_hz, lengths):
        self.steps = [max(1, round(rate_hz / SERIES_RATE_HZ)) for rate_hz in rates_hz]
        medians = zip(lengths.T, self.steps, strict=True)
        self.length = max(-(-median_length(of_source) // step) for of_source, step in medians)

    def series(self, signals):
        channels = np.concatenate(
            [
                at_length(signal.resample_poly(x, 1, step, axis=1) if step > 1 else x, self.length)
                for x, step in zip(signals, self.steps, strict=True)
            ]
        )
        return normalised(channels)

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
    setting = "9996 features, ridge"
    pretrained = True

    def __init__(self, seed: int):
        self.transform = MiniRocketTransform(n_kernels=10_000, random_state=seed, n_jobs=1)

    def pretrain(self, trials):
        self.transform.fit(np.stack([self.series(signals) for signals in trials]))

    def features(self, signals):
        return self.transform.transform(self.series(signals)[None])[0]

    def fit(self, features, labels):
        self.fit_ridge(features, labels, StandardScaler())

    def predict(self, features):
        return self.predict_ridge(features)


class HydraMethod(Series):
    name = "hydra"
    setting = "k=8 g=64, ridge"

    def __init__(self, seed: int):
        self.seed = seed

    def features(self, signals):
        return self.counts(self.series(signals))

    def counts(self, series):
        if not hasattr(self, "hydra"):
            self.hydra = Hydra(len(series), self.length, self.seed)
        return self.hydra.transform(series)

    def fit(self, features, labels):
        self.fit_ridge(features, labels, SparseScaler())

    def predict(self, features):
        return self.predict_ridge(features)


class MultiRocketHydra(MiniRocket):
    """Tan, Dempster, Bergmeir, Webb, "MultiRocket: multiple pooling operators and transformations
    for fast and effective time series classification", Data Mining and Knowledge Discovery 36,
    2022, as in aeon, and Hydra beside it: all features of both go to one ridge."""

    name = "multirocket+hydra"
    setting = "49,728 features and Hydra's, ridge"

    def __init__(self, seed: int):
        self.transform = MultiRocketTransform(random_state=seed, n_jobs=1)
        self.hydra = HydraMethod(seed)

    def prepare(self, rates_hz, lengths):
        super().prepare(rates_hz, lengths)
        self.hydra.prepare(rates_hz, lengths)

    def features(self, signals):
        series = self.series(signals)
        rocket = self.transform.transform(series[None])[0]
        self.split = len(rocket)
        return np.concatenate([rocket, self.hydra.counts(series)], dtype=np.float32)

    def fit(self, features, labels):
        self.fit_ridge(features, labels, Beside(self.split, StandardScaler(), SparseScaler()))


class Beside:
    """One scaler for the first features and another for the others."""

    def __init__(self, split: int, *scalers):
        self.split, self.scalers = split, scalers

    def fit(self, features):
        for scaler, part in self._parts(features):
            scaler.fit(part)
        return self

    def transform(self, features):
        return np.hstack([scaler.transform(part) for scaler, part in self._parts(features)])

    def _parts(self, features):
        return zip(self.scalers, np.split(features, [self.split], axis=1), strict=True)


class Quant(Method):
    """QUANT's features of each source at its own rate and median length, mean and scale taken out;
    its classifier: 200 extremely randomised trees, entropy, a tenth of all features at each
    split."""

    name = "quant"
    setting = "depth 6, v=4, 200 trees"

    def __init__(self, seed: int):
        self.seed = seed

    def prepare(self, rates_hz, lengths):
        self.lengths = [median_length(of_source) for of_source in lengths.T]

    def features(self, signals):
        sources = zip(signals, self.lengths, strict=True)
        series = (normalised(at_length(x, length)) for x, length in sources)
        return np.concatenate([quant.transform(x) for x in series])

    def fit(self, features, labels):
        self.model = ExtraTreesClassifier(
            200, criterion="entropy", max_features=0.1, random_state=self.seed, n_jobs=1
        )
        self.model.fit(features, labels)

    def predict(self, features):
        return self.model.predict(features[None])[0]


class LogBands(Method):
    """Mean and standard deviation over frames of the log energies of 40 bands from 0 to 7500 Hz,
    evenly spaced on the mel scale, for every channel; Hann frames of 2048 points, half overlapping.
    A source whose trials are short has frames of the largest power of two within a quarter of its
    median length, and a source whose rate is low has a band a bin at most. Means are taken out."""

    FRAME = 2048
    BANDS = 40
    BAND_HZ = 7500.0

    def prepare(self, rates_hz, lengths):
        self.layouts = []
        for rate_hz, of_source in zip(rates_hz, lengths.T, strict=True):
            frame = min(self.FRAME, 2 ** int(np.log2(max(4, median_length(of_source)) / 4)))
            frame = max(4, frame)
            if of_source.min() < frame:
                raise ValueError(f"{of_source.min()} samples; log bands need {frame} or more")
            self.layouts.append((frame, self.edges(frame, rate_hz)))

    def edges(self, frame, rate_hz):
        top_hz = min(self.BAND_HZ, rate_hz / 2)
        bands = min(self.BANDS, int(top_hz * frame / rate_hz))
        edges_hz = 700 * np.expm1(np.linspace(0, np.log1p(top_hz / 700), bands + 1))
        edges = np.round(edges_hz * frame / rate_hz).astype(int)
        for i in range(1, len(edges)):  # one bin at least
            edges[i] = max(edges[i], edges[i - 1] + 1)
        return edges

    def features(self, signals):
        sources = zip(signals, self.layouts, strict=True)
        return np.concatenate([self.of_source(x, *layout) for x, layout in sources])

    def of_source(self, series, frame, edges):
        centred = series - series.mean(1, keepdims=True)
        frames = np.lib.stride_tricks.sliding_window_view(centred, frame, axis=1)
        window = np.hanning(frame + 1)[:-1].astype(np.float32)
        power = np.abs(fft.rfft(frames[:, :: frame // 2] * window)[..., : edges[-1]]) ** 2
        bands = np.add.reduceat(power, edges[:-1], axis=2) / np.diff(edges)
        bands = np.log(bands + 1e-10)
        return np.concatenate([bands.mean(1), bands.std(1)], axis=None)


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
    "multirocket+hydra": MultiRocketHydra,
    "quant": Quant,
    "mmd-1": lambda seed: MmdMethod(1, seed),
    "mmd-10": lambda seed: MmdMethod(10, seed),
}
