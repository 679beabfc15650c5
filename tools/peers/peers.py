"""Other methods on the trials and folds of `surfaced eval DATA --protocol … --sources …`.

One process, one thread. See README.md.
"""

import argparse
import importlib.metadata
import json
import os
import platform
import sys
from pathlib import Path

from data import LEAVE_ONE_TRIAL_OUT, PROTOCOLS, DataError, folds, load
from evaluation import evaluate
from methods import METHODS

POINT_KEYS = (
    "method",
    "setting",
    "sources",
    "query_seconds",
    "accuracy",
    "accuracy_low",
    "accuracy_high",
    "users",
    "queries",
)
MS_KEYS = ("query_ms_p50", "query_ms_p99", "query_cpu_ms_p50")
PACKAGES = ("numpy", "scipy", "scikit-learn", "numba", "aeon")


def main() -> int:
    options = parse()
    try:
        data = load(options.data, options.sources)
        split = folds(data.trials, options.protocol)[: options.folds]
        chart = read_chart(options.chart, options.protocol) if options.chart else None
        found = f"{len(data.trials)} trials, {len(data.surfaces())} surfaces, {len(split)} folds"
        print(f"{found}, sources {', '.join(data.sources)}", file=sys.stderr)
        results = []
        print(HEADER, flush=True)
        for seconds in options.seconds or [None]:
            for name in options.methods:
                method = METHODS[name](options.seed)
                results.append(evaluate(method, data, split, options.protocol, seconds))
                print(row(results[-1]), flush=True)
        if options.out:
            write(options.out, {**machine(), "seed": options.seed, "results": results})
        if options.chart:
            join(chart, results)
            write(options.chart, chart)
    except (DataError, ValueError) as error:
        print(f"peers: {error}", file=sys.stderr)
        return 1
    return 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="run", description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="LMT108's root, or a library")
    parser.add_argument("--protocol", choices=PROTOCOLS, default=LEAVE_ONE_TRIAL_OUT)
    parser.add_argument(
        "--sources", type=lambda text: text.split(","), help="some of them (default: all)"
    )
    parser.add_argument(
        "--seconds",
        type=lambda text: None if text == "whole" else float(text),
        action="append",
        help="first seconds of the query, or `whole` (default); may be given several times",
    )
    parser.add_argument(
        "--methods",
        type=methods,
        default=list(METHODS),
        help=f"some of {','.join(METHODS)} (default: all)",
    )
    parser.add_argument("--folds", type=positive, help="only this many folds, from the first")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="results as JSON")
    parser.add_argument("--chart", type=Path, help="JSON of `surfaced chart`, to be joined")
    return parser.parse_args()


def positive(text: str) -> int:
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{number}; expected 1 or more")
    return number


def methods(text: str) -> list[str]:
    names = text.split(",")
    if unknown := sorted(set(names) - set(METHODS)):
        raise argparse.ArgumentTypeError(f"no such method: {', '.join(unknown)}")
    return names


COLUMNS = (
    "method",
    "setting",
    "query",
    "accuracy",
    "95 %",
    "mean ± sd of folds",
    "queries",
    "p50 ms",
    "p99 ms",
    "CPU p50 ms",
    "library",
    "load",
)
HEADER = f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}"


def row(result: dict) -> str:
    seconds = result["query_seconds"]
    cells = (
        result["method"],
        result["setting"],
        "whole" if seconds is None else f"{seconds:g} s",
        f"{result['accuracy']:.3f}",
        f"{result['accuracy_low']:.3f} to {result['accuracy_high']:.3f}",
        f"{result['accuracy_mean']:.3f} ± {result['accuracy_std']:.3f}",
        str(result["queries"]),
        *(milliseconds(result[key]) for key in MS_KEYS),
        str(result["library_trials"]),
        "{:.1f} to {:.1f}".format(*result["load_average"]),
    )
    return f"| {' | '.join(cells)} |"


def milliseconds(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def machine() -> dict:
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    versions["python"] = platform.python_version()
    return {"versions": versions, "threads": 1, "cores": os.cpu_count()}


def read_chart(path: Path, protocol: str) -> dict:
    try:
        chart = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError) as error:
        raise DataError(f"{path}: {error}; write it first, with `surfaced chart`") from error
    if not isinstance(chart, dict) or not isinstance(chart.get("points"), list):
        raise DataError(f"{path}: no list `points` in it; expected what `surfaced chart` writes")
    if chart.get("protocol") != protocol:
        raise DataError(f"{path}: measured by {chart.get('protocol')}, not by {protocol}")
    return chart


def join(chart: dict, results: list[dict]) -> None:
    """Puts the results among the chart's points, in place of earlier ones of the same name."""
    points = [point_of(result) for result in results]
    asked = {point["queries"] for point in [*chart["points"], *points] if "queries" in point}
    if len(asked) > 1:
        raise DataError(f"chart and peers do not ask the same queries: {sorted(asked)} of them")
    new = {identity(point) for point in points}
    points = [p for p in chart["points"] if not (p.get("peer") and identity(p) in new)] + points
    chart["points"] = points


def point_of(result: dict) -> dict:
    """A peer runs in one thread, so its CPU time is what the clock shows on a quiet machine."""
    latencies = {f"query_ms_{rank}": result[f"query_cpu_ms_{rank}"] for rank in ("p50", "p99")}
    return {**{k: result[k] for k in POINT_KEYS}, **latencies, "peer": True, "control": False}


def identity(point: dict) -> tuple:
    return point["method"], point["setting"], point["query_seconds"]


def write(path: Path, document: dict) -> None:
    beside = path.with_name(path.name + ".new")
    beside.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    beside.replace(path)


if __name__ == "__main__":
    sys.exit(main())
