"""The reference method in plain NumPy: n·MMD²_b between n amplitudes of two spectra, drawn at
positions that the whole library shares, averaged over R repetitions; the nearest trial names the
query. What everybody who has only NumPy would write, with the sums that can be shared shared."""

import numpy as np
from scipy import fft

BAND_HZ = 7500.0
SAMPLES = 400  # n
SIGMA_SAMPLES = 100


def amplitudes(signal: np.ndarray, rate_hz: float) -> np.ndarray:
    """2|X(f)|/L of the signal, padded to the next power of two, from 0 Hz to the band's end."""
    padded = 1 << (len(signal) - 1).bit_length()
    bins = min(int(BAND_HZ * padded / rate_hz), padded // 2) + 1
    spectrum = fft.rfft(signal.astype(np.float64), padded)[:bins]
    return 2 / len(signal) * np.abs(spectrum)


def sigma_of(samples: np.ndarray) -> float:
    """The length scale: σ² is half the median of the squared distances, other than zero, between
    the first 100 samples; 1 where there are none."""
    first = samples[:SIGMA_SAMPLES]
    i, j = np.triu_indices(len(first), 1)
    squares = (first[i] - first[j]) ** 2
    squares = squares[squares > 0]
    return float(np.sqrt(0.5 * np.median(squares))) if len(squares) else 1.0


class Mmd:
    """Library trials' samples, centred: that is the mean shift, since the kernel sees differences
    alone. Kernel matrices in float32, sums in pairs (error of a score below 1e-3, see check.py)."""

    def __init__(self, library: np.ndarray, repetitions: int, seed: int):
        """`library`: amplitudes, shape (trials, bins)."""
        rng = np.random.default_rng(seed)
        bins = library.shape[1]
        draw = min(SAMPLES, bins)
        self.positions = [
            rng.choice(bins, draw, replace=False, shuffle=True) for _ in range(repetitions)
        ]
        self.samples = [_centred(library[:, at]) for at in self.positions]
        self.kernel = np.empty((draw, draw), np.float32)

    def scores(self, query: np.ndarray) -> np.ndarray:
        """Mean score of each library trial; `query`: amplitudes."""
        total = np.zeros(len(self.samples[0]))
        for at, library in zip(self.positions, self.samples, strict=True):
            z = _centred(query[at])
            scale = np.sqrt(0.5) / sigma_of(z)  # exp(−d²/2σ²) = exp(−(scale·d)²)
            z = (scale * z).astype(np.float32)
            zz = self._kernel_mean(z, z)
            for i, y in enumerate((scale * library).astype(np.float32)):
                mmd2 = self._kernel_mean(y, y) + zz - 2 * self._kernel_mean(y, z)
                total[i] += len(z) * mmd2
        return total / len(self.positions)

    def _kernel_mean(self, a: np.ndarray, b: np.ndarray) -> float:
        kernel = np.subtract.outer(a, b, out=self.kernel)
        np.multiply(kernel, kernel, out=kernel)
        np.negative(kernel, out=kernel)
        np.exp(kernel, out=kernel)
        return float(kernel.mean())


def _centred(samples: np.ndarray) -> np.ndarray:
    return samples - samples.mean(-1, keepdims=True)
