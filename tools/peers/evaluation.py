"""Runs a peer over all folds, one query at a time, and sums it up as `surfaced eval` does."""

import math
import os
import time
from dataclasses import dataclass

import numpy as np

from data import DataError, Fold, Trial
from methods import Method

Z_95 = 1.959963984540054


@dataclass
class Answer:
    fold: int
    right: bool
    wall_ms: float
    cpu_ms: float


def windows_of(samples: np.ndarray, length: int) -> list[np.ndarray]:
    """Windows of that length, one after the other; a rest is left out."""
    return [samples[i : i + length] for i in range(0, len(samples) - length + 1, length)]


def shifts(
    method: Method, trials: list[Trial], folds: list[Fold]
) -> list[tuple[list[int], list[int]]]:
    """Folds that share features, by number, and the trials from which these are pretrained.

    Pretraining for each fold would take most of the time. Two shifts will do: the first half of
    the folds pretrains on trials that are queries of none of them, and so does the second.
    """
    numbers = list(range(len(folds)))
    if not method.pretrained:
        return [(numbers, [])]
    half = len(folds) // 2
    parts = [part for part in (numbers[:half], numbers[half:]) if part]
    return [
        (part, sorted(set.intersection(*(set(folds[number].library) for number in part))))
        for part in parts
    ]


def query_length(trials: list[Trial], seconds: float | None) -> int:
    """Samples of a query: so many seconds, or the whole, which is the shortest trial's length."""
    shortest = min(trials, key=lambda trial: len(trial.samples))
    if seconds is None:
        return len(shortest.samples)
    length = round(seconds * shortest.rate_hz)
    if not 0 < length <= len(shortest.samples):
        whole_s = len(shortest.samples) / shortest.rate_hz
        raise DataError(f"{shortest.path}: {whole_s:.3f} s long; {seconds} s were asked for")
    return length


def evaluate(
    method: Method, trials: list[Trial], folds: list[Fold], seconds: float | None
) -> dict:
    """Accuracy over queries and folds, and latencies: from raw samples to the label."""
    load_before = os.getloadavg()[0]
    length = query_length(trials, seconds)
    method.prepare(trials[0].rate_hz, length)
    surfaces = sorted({trial.surface for trial in trials})
    cut = windows_of if method.windows and seconds is not None else lambda x, n: [x[:n]]
    answers = []
    for numbers, unlabelled in shifts(method, trials, folds):
        method.pretrain([w for i in unlabelled for w in cut(trials[i].samples, length)])
        features = [
            np.stack([method.features(window) for window in cut(trial.samples, length)])
            for trial in trials
        ]
        for number in numbers:
            fold = folds[number]
            of_class = [surfaces.index(trials[i].surface) for i in fold.library]
            labels = np.repeat(of_class, [len(features[i]) for i in fold.library])
            method.fit(np.concatenate([features[i] for i in fold.library]), labels)
            method.predict(method.features(trials[fold.library[0]].samples[:length]))  # warms up
            for i in fold.queries:
                query = trials[i].samples[:length].copy()
                wall, cpu = time.perf_counter(), time.process_time()
                label = method.predict(method.features(query))
                cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
                right = surfaces[label] == trials[i].surface
                answers.append(Answer(number, right, wall * 1e3, cpu * 1e3))
    result = summary(answers, len(folds))
    result.update(
        method=method.name,
        setting=method.setting,
        sources=["mi2"],
        query_seconds=seconds,
        library_trials=max(len(fold.library) for fold in folds),
        classes=len(surfaces),
        load_average=[load_before, os.getloadavg()[0]],
    )
    return result


def summary(answers: list[Answer], folds: int) -> dict:
    by_fold = [[a.right for a in answers if a.fold == fold] for fold in range(folds)]
    accuracies = [float(np.mean(rights)) for rights in by_fold]
    right = sum(a.right for a in answers)
    low, high = wilson(right, len(answers))
    wall_ms = sorted(a.wall_ms for a in answers)
    return {
        "accuracy": right / len(answers),
        "accuracy_low": low,
        "accuracy_high": high,
        "accuracy_mean": float(np.mean(accuracies)),
        "accuracy_std": float(np.std(accuracies, ddof=1)) if folds > 1 else 0.0,
        "folds": accuracies,
        "queries": len(answers),
        "query_ms_p50": nearest_rank(wall_ms, 0.5),
        "query_ms_p99": nearest_rank(wall_ms, 0.99),
        "query_cpu_ms_p50": nearest_rank(sorted(a.cpu_ms for a in answers), 0.5),
    }


def wilson(right: int, queries: int) -> tuple[float, float]:
    """95 % Wilson interval."""
    share, z2 = right / queries, Z_95**2
    centre = share + z2 / (2 * queries)
    half = Z_95 * math.sqrt(share * (1 - share) / queries + z2 / (4 * queries**2))
    scale = 1 + z2 / queries
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


def nearest_rank(ascending: list[float], quantile: float) -> float:
    return ascending[max(0, math.ceil(quantile * len(ascending)) - 1)]
