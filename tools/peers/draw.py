"""Draws charts with the peers' points in them: accuracy against latency, a panel a chart, and one
table of numbers. A single chart has a second panel, accuracy against scan time.

    run --draw OUT.svg CHART.json…     each written by `surfaced chart`, then by `run --chart`
"""

import json
import sys
from itertools import zip_longest
from pathlib import Path

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams["svg.fonttype"] = "none"
# The same picture from the same numbers.
matplotlib.rcParams["svg.hashsalt"] = "surfaced"
import matplotlib.pyplot as plt  # noqa: E402

COLOURS = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9",
    "#e69f00", "#6e5028", "#000000", "#785ef0", "#a0a000",
]  # fmt: skip


def key(point: dict) -> tuple:
    return point["method"], point["setting"]


def shown(chart: dict, timed: bool = False) -> list[dict]:
    """Points of methods with all sources: on whole drags, or at every scan time if `timed`."""
    points = [point for point in chart["points"] if not point["control"]]
    points = [p for p in points if p["peer"] or len(p["sources"]) == len(chart["sources"])]
    if not timed:
        return [point for point in points if point["query_seconds"] is None]
    short = {key(point) for point in points if point["query_seconds"] is not None}
    return [point for point in points if key(point) in short]


def controls(chart: dict) -> list[dict]:
    return [point for point in chart["points"] if point["control"]]


def marks(axes, points: list[dict], rows: list[tuple], x_of) -> None:
    """Points with their intervals and each user's share, numbered as the table's rows."""
    for point in points:
        row, x = rows.index(key(point)), x_of(point)
        colour = COLOURS[row % len(COLOURS)]
        axes.vlines(x, point["accuracy_low"], point["accuracy_high"], colour, alpha=0.5)
        users = [user["accuracy"] for user in point.get("users", [])]
        axes.scatter([x] * len(users), users, marker="_", color=colour, linewidths=0.8)
        shape = "s" if point["peer"] else "o"
        axes.plot(x, point["accuracy"], shape, color=colour, markersize=5)
        axes.annotate(str(row + 1), (x, point["accuracy"]), (4, 4), textcoords="offset points")


def panel(axes, chart: dict) -> None:
    """The frame that both kinds of panel share: title, controls, axis of accuracy."""
    kind = "SYNTHETIC " if chart["synthetic"] else ""
    queries = max(point["queries"] for point in shown(chart))
    axes.set_title(
        f"{kind}{chart['data']}, {chart['protocol']}\n{chart['surfaces']} surfaces, "
        f"{chart['library_trials']} library trials, {queries} queries", fontsize=9, loc="left",
    )  # fmt: skip
    for letter, control in zip("abcdefgh", controls(chart)):
        axes.axhline(control["accuracy"], color="grey", linestyle="--", linewidth=0.8)
        axes.annotate(letter, (0.01, control["accuracy"]), xycoords=("axes fraction", "data"))
    axes.set_ylim(top=1.06)
    axes.yaxis.set_major_formatter(matplotlib.ticker.PercentFormatter(1, decimals=0))
    axes.grid(alpha=0.2)


def draw(charts: list[dict]) -> plt.Figure:
    rows = list(dict.fromkeys(key(point) for chart in charts for point in shown(chart)))
    plots = [(chart, False) for chart in charts]
    if len(charts) == 1 and shown(charts[0], timed=True):
        plots.append((charts[0], True))
    height = -(-len(plots) // 2)
    lines = len(rows) + max(len(controls(chart)) for chart in charts) + 1
    figure = plt.figure(figsize=(10, 3.6 * height + 0.25 * lines), layout="constrained")
    table_share = 0.25 * lines / 3.6
    grid = figure.add_gridspec(height + 1, 2, height_ratios=[1] * height + [table_share])
    first = None
    for at, (chart, timed) in enumerate(plots):
        axes = figure.add_subplot(grid[divmod(at, 2)], sharey=first, sharex=None if timed else first)
        first = first or axes
        panel(axes, chart)
        if timed:
            seconds = lambda point: point["query_seconds"] or chart["drag_s"]  # noqa: E731
            marks(axes, shown(chart, timed=True), rows, seconds)
            axes.set_xlabel("scan time used [s]")
        else:
            axes.set_xscale("log")
            marks(axes, shown(chart), rows, lambda point: max(point["query_ms_p50"], 1e-3))
            axes.set_xlabel("median latency of a query [ms]")
    table(figure.add_subplot(grid[height, :]), charts, rows)
    figure.suptitle(
        "Accuracy against speed (bars: 95 % intervals; ticks: users; squares: programs of others; "
        "dashed: negative controls)", fontsize=10,
    )  # fmt: skip
    return figure


def table(axes, charts: list[dict], rows: list[tuple]) -> None:
    axes.axis("off")
    value = lambda p: f"{p['accuracy']:.1%}, {p['query_ms_p50']:.3g} ms" if p else "–"  # noqa: E731
    cells, colours = [], []
    for number, row in enumerate(rows, start=1):
        found = [next((p for p in shown(chart) if key(p) == row), None) for chart in charts]
        setting = row[1].removeprefix(f"--method {row[0]}").strip()
        cells.append([f"{number}  {row[0]} {setting}", *map(value, found)])
        colours.append(COLOURS[(number - 1) % len(COLOURS)])
    for letter, of_charts in zip("abcdefgh", zip_longest(*map(controls, charts))):
        names = list(dict.fromkeys(point["setting"] for point in of_charts if point))
        cells.append([f"{letter}  {' or '.join(names)}", *map(value, of_charts)])
        colours.append("grey")
    drawn = axes.table(
        cells,
        colLabels=["", *(f"{chart['data']}, {chart['protocol']}" for chart in charts)],
        colWidths=[0.44] + [0.56 / len(charts)] * len(charts),
        cellLoc="left",
        edges="open",
        bbox=[0, 0, 1, 1],
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(7)
    for row, colour in enumerate(colours, start=1):
        drawn[row, 0].get_text().set_color(colour)


def main(arguments: list[str]) -> None:
    if len(arguments) < 2:
        sys.exit("run --draw OUT.svg CHART.json…: name the picture and at least one chart")
    out, *paths = map(Path, arguments)
    charts = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    for path, chart in zip(paths, charts):
        if not chart.get("points") or not shown(chart):
            sys.exit(f"{path}: no point for whole drags in it; write it with `surfaced chart`")
    draw(charts).savefig(out, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    main(sys.argv[1:])
