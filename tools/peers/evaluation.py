"""Runs a peer over all folds, one query at a time, and sums it up as `surfaced eval` does."""

import math
import os
import time
from dataclasses import dataclass

import numpy as np
from scipy import stats

from data import LEAVE_ONE_TRIAL_OUT, Data, DataError, Fold, Signals
from methods import Method

Z_95 = 1.959963984540054
LEAST_USERS = 3  # of an interval over users


@dataclass
class Answer:
    fold: int
    right: bool
    wall_ms: float
    cpu_ms: float


def windows_of(signals: Signals, lengths: list[int]) -> list[Signals]:
    """Windows of those lengths, one after the other; a rest is left out."""
    count = min(x.shape[1] // length for x, length in zip(signals, lengths, strict=True))
    return [
        tuple(x[:, i * n : (i + 1) * n] for x, n in zip(signals, lengths, strict=True))
        for i in range(count)
    ]


def shifts(method: Method, folds: list[Fold]) -> list[tuple[list[int], list[int]]]:
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


def query_lengths(data: Data, seconds: float) -> list[int]:
    """Samples of each source in the first seconds."""
    lengths = [round(seconds * rate_hz) for rate_hz in data.rates_hz]
    for trial in data.trials:
        for x, length, rate_hz in zip(trial.signals, lengths, data.rates_hz, strict=True):
            if not 0 < length <= x.shape[1]:
                raise DataError(f"{trial.path}: {x.shape[1] / rate_hz:.3f} s; query of {seconds} s")
    return lengths


def evaluate(
    method: Method, data: Data, folds: list[Fold], protocol: str, seconds: float | None
) -> dict:
    """Accuracy over queries and folds, and latencies: from raw samples to the label."""
    load_before = os.getloadavg()[0]
    trials, surfaces = data.trials, data.surfaces()
    of_query = None if seconds is None else query_lengths(data, seconds)

    def cut(signals: Signals) -> list[Signals]:
        return [signals] if of_query is None else windows_of(signals, of_query)

    most = None if method.windows else 1  # windows of a library's trial
    method.prepare(data.rates_hz, data.lengths() if of_query is None else np.array([of_query]))
    answers = []
    for numbers, unlabelled in shifts(method, folds):
        method.pretrain([w for i in unlabelled for w in cut(trials[i].signals)])
        features = [
            np.stack([method.features(window) for window in cut(trial.signals)[:most]])
            for trial in trials
        ]
        for number in numbers:
            fold = folds[number]
            of_class = [surfaces.index(trials[i].surface) for i in fold.library]
            labels = np.repeat(of_class, [len(features[i]) for i in fold.library])
            method.fit(np.concatenate([features[i] for i in fold.library]), labels)
            method.predict(method.features(cut(trials[fold.library[0]].signals)[0]))  # warms up
            for i in fold.queries:
                query = tuple(x.copy() for x in cut(trials[i].signals)[0])
                wall, cpu = time.perf_counter(), time.process_time()
                label = method.predict(method.features(query))
                cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
                right = surfaces[label] == trials[i].surface
                answers.append(Answer(number, right, wall * 1e3, cpu * 1e3))
    result = summary(answers, [fold.name for fold in folds], protocol != LEAVE_ONE_TRIAL_OUT)
    result.update(
        method=method.name,
        setting=method.setting,
        sources=sorted(data.sources),
        query_seconds=seconds,
        library_trials=max(len(fold.library) for fold in folds),
        classes=len(surfaces),
        load_average=[load_before, os.getloadavg()[0]],
    )
    return result


def summary(answers: list[Answer], names: list[str], folds_are_users: bool) -> dict:
    by_fold = [[a.right for a in answers if a.fold == fold] for fold in range(len(names))]
    accuracies = [float(np.mean(rights)) for rights in by_fold]
    users = [
        {"name": name, "accuracy": accuracy, "queries": len(rights)}
        for name, accuracy, rights in zip(names, accuracies, by_fold, strict=True)
        if folds_are_users
    ]
    right = sum(a.right for a in answers)
    low, high = interval(right, len(answers), users)
    wall_ms = sorted(a.wall_ms for a in answers)
    cpu_ms = sorted(a.cpu_ms for a in answers)
    return {
        "accuracy": right / len(answers),
        "accuracy_low": low,
        "accuracy_high": high,
        "accuracy_mean": float(np.mean(accuracies)),
        "accuracy_std": float(np.std(accuracies, ddof=1)) if len(names) > 1 else 0.0,
        "folds": accuracies,
        "users": users,
        "queries": len(answers),
        "query_ms_p50": nearest_rank(wall_ms, 0.5),
        "query_ms_p99": nearest_rank(wall_ms, 0.99),
        "query_cpu_ms_p50": nearest_rank(cpu_ms, 0.5),
        "query_cpu_ms_p99": nearest_rank(cpu_ms, 0.99),
    }


def interval(right: int, queries: int, users: list[dict]) -> tuple[float, float]:
    """95 % interval of the share of all queries, as in `surfaced chart`: over users where there are
    three or more, else over queries. Over users it is Wilson's for as many queries as vary as much,
    and for so few users (Korn & Graubard 1998)."""
    n = len(users)
    if n < LEAST_USERS:
        return wilson(right / queries, queries)
    share = right / queries
    squares = sum((user["queries"] * (user["accuracy"] - share)) ** 2 for user in users)
    binomial = share * (1 - share) * queries
    effect = max(1.0, squares * n / (n - 1) / binomial) if binomial > 0 else 1.0
    return wilson(share, queries / effect * (Z_95 / stats.t.ppf(0.975, n - 1)) ** 2)


def wilson(share: float, queries: float) -> tuple[float, float]:
    """95 % Wilson interval."""
    z2 = Z_95**2
    centre = share + z2 / (2 * queries)
    half = Z_95 * math.sqrt(share * (1 - share) / queries + z2 / (4 * queries**2))
    scale = 1 + z2 / queries
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


def nearest_rank(ascending: list[float], quantile: float) -> float:
    return ascending[max(0, math.ceil(quantile * len(ascending)) - 1)]
