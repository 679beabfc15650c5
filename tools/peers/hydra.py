"""Hydra: Dempster, Schmidt, Webb, "Hydra: competing convolutional kernels for fast and accurate
time series classification", Data Mining and Knowledge Discovery 37, 2023, written from the paper.

Random kernels of length 9 come in g groups of k for each dilation 1, 2, 4, …; half of the groups
see the series, half its first difference. At each time the kernel of a group with the largest
response wins (its response is added to its count: a soft count), and that with the smallest
(counted as 1: a hard count).
"""

import numba
import numpy as np

TAPS = 9
KERNELS = 8  # k
GROUPS = 64  # g, of a dilation
BLOCK = 512  # time steps worked on at once; bounds the buffers, not the result


class Hydra:
    """The transform of series of one length. It does not depend on the training data."""

    def __init__(self, length: int, seed: int):
        dilations = int(np.log2((length - 1) / (TAPS - 1))) + 1
        shape = (dilations, 2, GROUPS // 2, KERNELS, TAPS)
        weights = np.random.default_rng(seed).standard_normal(shape)
        weights -= weights.mean(-1, keepdims=True)
        weights /= np.abs(weights).sum(-1, keepdims=True)
        self.weights = weights.astype(np.float32)

    def transform(self, series: np.ndarray) -> np.ndarray:
        """Counts of one series, flattened: dilation, series or difference, group, kernel, soft
        then hard."""
        views = (series.astype(np.float32), np.diff(series).astype(np.float32))
        counts = np.zeros((*self.weights.shape[:-1], 2))
        for exponent, of_dilation in enumerate(self.weights):
            dilation = 2**exponent
            for view, weights in enumerate(of_dilation):
                padded = np.pad(views[view], (TAPS - 1) // 2 * dilation)
                _count(padded, weights, dilation, counts[exponent, view])
        return counts.reshape(-1)


@numba.njit(fastmath=True, cache=True)
def _count(padded, weights, dilation, counts):
    length = padded.size - (TAPS - 1) * dilation
    response = np.empty((KERNELS, BLOCK), np.float32)
    for group in range(weights.shape[0]):
        for start in range(0, length, BLOCK):
            size = min(BLOCK, length - start)
            for kernel in range(KERNELS):
                row = response[kernel, :size]
                w = weights[group, kernel]
                w0, w1, w2, w3, w4, w5, w6, w7, w8 = w
                for t in range(size):
                    at = start + t
                    row[t] = (
                        w0 * padded[at]
                        + w1 * padded[at + dilation]
                        + w2 * padded[at + 2 * dilation]
                        + w3 * padded[at + 3 * dilation]
                        + w4 * padded[at + 4 * dilation]
                        + w5 * padded[at + 5 * dilation]
                        + w6 * padded[at + 6 * dilation]
                        + w7 * padded[at + 7 * dilation]
                        + w8 * padded[at + 8 * dilation]
                    )
            _compete(response, size, counts[group])


@numba.njit(fastmath=True, cache=True)
def _compete(response, size, counts):
    best = np.empty(BLOCK, np.float32)
    least = np.empty(BLOCK, np.float32)
    winner = np.zeros(BLOCK, np.int32)
    loser = np.zeros(BLOCK, np.int32)
    best[:size] = response[0, :size]
    least[:size] = response[0, :size]
    for kernel in range(1, KERNELS):
        row = response[kernel]
        k = np.int32(kernel)
        for t in range(size):
            winner[t] = k if row[t] > best[t] else winner[t]
            best[t] = max(row[t], best[t])
            loser[t] = k if row[t] < least[t] else loser[t]
            least[t] = min(row[t], least[t])
    for kernel in range(KERNELS):
        k = np.int32(kernel)
        soft = np.float32(0.0)
        hard = np.int32(0)
        for t in range(size):
            soft += best[t] if winner[t] == k else np.float32(0.0)
            hard += np.int32(1) if loser[t] == k else np.int32(0)
        counts[kernel, 0] += soft
        counts[kernel, 1] += hard


def transform_plainly(hydra: Hydra, series: np.ndarray) -> np.ndarray:
    """The same in plain NumPy, slow and obvious: the oracle of `Hydra.transform`."""
    result = []
    for exponent, of_dilation in enumerate(hydra.weights):
        dilation = 2**exponent
        for view, weights in zip((series, np.diff(series)), of_dilation, strict=True):
            padded = np.pad(view.astype(np.float64), (TAPS - 1) // 2 * dilation)
            taps = [padded[j * dilation :][: len(view)] for j in range(TAPS)]
            response = np.einsum("gkj,jt->gkt", weights.astype(np.float64), np.stack(taps))
            for kernel_by_time in response:
                winner, loser = kernel_by_time.argmax(0), kernel_by_time.argmin(0)
                soft = np.bincount(winner, kernel_by_time.max(0), minlength=KERNELS)
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
