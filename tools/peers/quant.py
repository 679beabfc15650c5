"""QUANT: Dempster, Schmidt, Webb, "QUANT: a minimalist interval method for time series
classification", Data Mining and Knowledge Discovery 38, 2024, written here after the paper.

Quantiles over dyadic intervals of four representations of a series: itself, its first difference
(smoothed), its second difference, and the magnitudes of its discrete Fourier transform. The paper's
classifier on top is in methods.py.
"""

import numpy as np

DEPTH = 6
SAMPLES_PER_QUANTILE = 4  # v
SMOOTHED = 5


def representations(series: np.ndarray) -> list[np.ndarray]:
    """Of series of shape (channels, samples)."""
    series = series.astype(np.float64)
    half = SMOOTHED // 2
    first = np.pad(np.diff(series), ((0, 0), (half, half)), mode="edge")
    sums = np.cumsum(np.pad(first, ((0, 0), (1, 0))), axis=1)
    smooth = (sums[:, SMOOTHED:] - sums[:, :-SMOOTHED]) / SMOOTHED
    return [series, smooth, np.diff(series, 2), np.abs(np.fft.rfft(series))]


def intervals(length: int) -> list[tuple[int, int]]:
    """1, 2, 4, … intervals that cover a series, down to depth 6 or to single samples, and the
    same shifted by half of an interval."""
    found = []
    for depth in range(min(DEPTH, int(np.log2(length)) + 1)):
        edges = np.linspace(0, length, 2**depth + 1).astype(int)
        found += zip(edges[:-1], edges[1:], strict=True)
        width = np.median(np.diff(edges))
        if depth > 0 and width > 1:
            shift = int(np.ceil(width / 2))
            found += zip(edges[:-2] + shift, edges[1:-1] + shift, strict=True)
    return found


def quantiles(values: np.ndarray) -> np.ndarray:
    """Evenly spaced quantiles from least to greatest, one for four samples, of each row; the row's
    mean is subtracted from every second one. A single quantile is the median."""
    count = 1 + (values.shape[1] - 1) // SAMPLES_PER_QUANTILE
    at = np.linspace(0, 1, count) if count > 1 else np.array([0.5])
    at = at * (values.shape[1] - 1)
    below = at.astype(int)
    ascending = np.sort(values, axis=1)
    above = ascending[:, np.minimum(below + 1, values.shape[1] - 1)]
    found = ascending[:, below] + (at - below) * (above - ascending[:, below])
    found[:, 1::2] -= values.mean(1, keepdims=True)
    return found


def transform(series: np.ndarray) -> np.ndarray:
    """Features of series of shape (channels, samples), flattened."""
    return np.concatenate(
        [
            quantiles(view[:, start:end]).ravel()
            for view in representations(series)
            for start, end in intervals(view.shape[1])
        ],
        dtype=np.float32,
    )


def transform_plainly(series: np.ndarray) -> np.ndarray:
    """The same by NumPy's quantiles and plain loops: the oracle of `transform`."""
    first = np.diff(series)
    last = first.shape[1] - 1
    near = [np.clip(np.arange(last + 1) + k, 0, last) for k in (-2, -1, 0, 1, 2)]
    smooth = np.mean([first[:, at] for at in near], axis=0)
    spectrum = np.abs(np.fft.fft(series))[:, : series.shape[1] // 2 + 1]
    result = []
    for view in (series, smooth, np.diff(np.diff(series)), spectrum):
        for start, end in intervals(view.shape[1]):
            for row in view:
                values = row[start:end]
                count = 1 + (len(values) - 1) // 4
                for k in range(count):
                    quantile = np.quantile(values, k / (count - 1) if count > 1 else 0.5)
                    result.append(quantile - values.mean() * (k % 2))
    return np.array(result)
