"""Hydra: Dempster, Schmidt, Webb, "Hydra: competing convolutional kernels for fast and accurate
time series classification", Data Mining and Knowledge Discovery 37, 2023, written here after the
paper; details such as the scaling were looked up in the authors' published code, none of which is
copied.

Random kernels of length 9 come in g groups of k for each dilation 1, 2, 4, …; half of the groups
see the series, half its first difference. At each time the kernel of a group with the largest
response wins (its response is added to its count: a soft count), and that with the smallest
(counted as 1: a hard count). Of several channels each group sees the sum of a few, drawn at random:
half of them, but 2 at least and 8 at most.
"""

import numba
import numpy as np

TAPS = 9
KERNELS = 8  # k
GROUPS = 64  # g, of a dilation
MOST_CHANNELS = 8  # that a group sees
BLOCK = 512  # time steps worked on at once; bounds the buffers, not the result


class Hydra:
    """The transform of series of one length and number of channels. It does not depend on the
    training data."""

    def __init__(self, channels: int, length: int, seed: int):
        dilations = int(np.log2((length - 1) / (TAPS - 1))) + 1
        shape = (dilations, 2, GROUPS // 2, KERNELS, TAPS)
        rng = np.random.default_rng(seed)
        weights = rng.standard_normal(shape)
        weights -= weights.mean(-1, keepdims=True)
        weights /= np.abs(weights).sum(-1, keepdims=True)
        self.weights = weights.astype(np.float32)
        seen = min(channels, max(2, min(channels // 2, MOST_CHANNELS)))
        drawn = rng.random((*shape[:3], channels)).argsort(-1)
        self.channels = drawn[..., :seen]  # of each group

    def transform(self, series: np.ndarray) -> np.ndarray:
        """Counts of a series of shape (channels, samples), flattened: dilation, series or
        difference, group, kernel, soft then hard."""
        views = (series.astype(np.float32), np.diff(series).astype(np.float32))
        counts = np.zeros((*self.weights.shape[:-1], 2))
        for exponent, of_dilation in enumerate(self.weights):
            dilation = 2**exponent
            for view, weights in enumerate(of_dilation):
                ends = (TAPS - 1) // 2 * dilation
                padded = np.pad(views[view], ((0, 0), (ends, ends)))
                seen = self.channels[exponent, view]
                _count(padded, seen, weights, dilation, counts[exponent, view])
        return counts.reshape(-1)


@numba.njit(fastmath=True, cache=True)
def _count(padded, seen, weights, dilation, counts):
    length = padded.shape[1] - (TAPS - 1) * dilation
    response = np.empty((KERNELS, BLOCK), np.float32)
    most = np.empty((4, BLOCK), np.float32)
    for group in range(weights.shape[0]):
        series = padded[seen[group, 0]]
        for channel in seen[group, 1:]:
            series = series + padded[channel]
        for start in range(0, length, BLOCK):
            size = min(BLOCK, length - start)
            for kernel in range(KERNELS):
                _convolve(series[start:], weights[group, kernel], dilation, response[kernel, :size])
            _compete(response, size, most, counts[group])


@numba.njit(fastmath=True, cache=True)
def _convolve(x, w, d, out):
    # one slice a tap: the compiler then sees loops without index checks, and vectorises them
    n = out.size
    w0, w1, w2, w3, w4, w5, w6, w7, w8 = w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8]
    x0, x1, x2 = x[:n], x[d : d + n], x[2 * d : 2 * d + n]
    x3, x4, x5 = x[3 * d : 3 * d + n], x[4 * d : 4 * d + n], x[5 * d : 5 * d + n]
    x6, x7, x8 = x[6 * d : 6 * d + n], x[7 * d : 7 * d + n], x[8 * d : 8 * d + n]
    for t in range(n):
        first = w0 * x0[t] + w1 * x1[t] + w2 * x2[t]
        middle = w3 * x3[t] + w4 * x4[t] + w5 * x5[t]
        out[t] = first + middle + w6 * x6[t] + w7 * x7[t] + w8 * x8[t]


@numba.njit(fastmath=True, cache=True)
def _compete(response, n, most, counts):
    # whole rows, contiguous and all f32, again for the compiler; `open` is 1 until a time has its
    # winner, so that the first of equal kernels takes it
    best, least, open_best, open_least = most[0, :n], most[1, :n], most[2, :n], most[3, :n]
    one, nil = np.float32(1), np.float32(0)
    first = response[0, :n]
    for t in range(n):
        best[t] = first[t]
        least[t] = first[t]
        open_best[t] = one
        open_least[t] = one
    for kernel in range(1, KERNELS):
        row = response[kernel, :n]
        for t in range(n):
            best[t] = row[t] if row[t] > best[t] else best[t]
        for t in range(n):
            least[t] = row[t] if row[t] < least[t] else least[t]
    for kernel in range(KERNELS):
        row = response[kernel, :n]
        soft, hard = nil, nil
        for t in range(n):
            won = open_best[t] if row[t] == best[t] else nil
            open_best[t] -= won
            soft += won * best[t]
        for t in range(n):
            lost = open_least[t] if row[t] == least[t] else nil
            open_least[t] -= lost
            hard += lost
        counts[kernel, 0] += soft
        counts[kernel, 1] += hard


def transform_plainly(hydra: Hydra, series: np.ndarray) -> np.ndarray:
    """The same in plain NumPy, slow and obvious: the oracle of `Hydra.transform`."""
    result = []
    for exponent, of_dilation in enumerate(hydra.weights):
        views = zip((series, np.diff(series)), of_dilation, hydra.channels[exponent], strict=True)
        for view, weights, of_groups in views:
            dilation, length = 2**exponent, view.shape[1]
            ends = (TAPS - 1) // 2 * dilation
            for kernels, seen in zip(weights, of_groups, strict=True):
                padded = np.pad(view[seen].astype(np.float64).sum(0), ends)
                taps = np.stack([padded[j * dilation :][:length] for j in range(TAPS)])
                responses = kernels.astype(np.float64) @ taps
                winner, loser = responses.argmax(0), responses.argmin(0)
                soft = np.bincount(winner, responses.max(0), minlength=KERNELS)
                hard = np.bincount(loser, minlength=KERNELS)
                result.append(np.stack([soft, hard], axis=1))
    return np.stack(result).reshape(-1)


class SparseScaler:
    """Scales counts: square roots, standardised, zeros kept at zero, and rarely used kernels held
    down by adding the fourth power of their share of zeros to their deviation."""

    def fit(self, counts: np.ndarray) -> "SparseScaler":
        roots = np.sqrt(np.maximum(counts, 0))
        self.mean = roots.mean(0)
        self.scale = roots.std(0, ddof=1) + (roots == 0).mean(0) ** 4 + 1e-8
        return self

    def transform(self, counts: np.ndarray) -> np.ndarray:
        roots = np.sqrt(np.maximum(counts, 0))
        return np.where(roots != 0, (roots - self.mean) / self.scale, 0)
