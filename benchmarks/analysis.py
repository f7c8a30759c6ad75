"""Evaluates runs: medians over seeds, errors at equal time, ratios to an earlier result."""

import math
import statistics
from collections.abc import Iterable
from typing import Any

from report import Table, number

RESOLUTION = 0.05
"""Errors below this share of the reference's own relMSE cannot be distinguished, and count as this share."""
REGRESSION = 1.10
"""A result whose time x error has grown by more than this factor is marked, and fails the comparison."""
TARGETS = {"cornell_box": 10.0, "crowded_room": 10.0, "corridor": 50.0}
"""Goal by scene: Mitsuba's path tracing error divided by ours, at equal time."""
DENOISED_TARGET = 2.0
"""Goal for all scenes: the error of the denoised peer divided by ours, at equal time."""

Row = dict[str, Any]
"""A run, or the medians of several: names and numbers as in the JSON file."""


def summarize(runs: Iterable[Row]) -> list[Row]:
    """The medians over the seeds and the range of the error, one row for each scene, method and time budget."""
    groups: dict[tuple[str, str, float], list[Row]] = {}
    for run in runs:
        groups.setdefault((run["scene"], run["method"], run["budget"]), []).append(run)
    rows = []
    for (scene, method, budget), group in groups.items():
        errors = [run["error"] for run in group]
        row = {"scene": scene, "method": method, "budget": budget, "seeds": len(group)}
        row |= {"floor": group[0]["floor"], "unit": group[0].get("unit", 1.0)}
        for key in ("seconds", "error", "mean_ratio", "samples", "flip", "pattern"):
            values = [run[key] for run in group if run.get(key) is not None]
            row[key] = statistics.median(values) if values else None
        rows.append({**row, "error_low": min(errors), "error_high": max(errors)})
    return rows


def resolved(row: Row, key: str = "error") -> float:
    """The error, at least the resolution of the reference: ratios of such errors are meaningful."""
    return max(row[key], 1e-12 if key == "flip" else RESOLUTION * row["floor"], 1e-12)


def error_at(curve: list[Row], seconds: float, key: str = "error") -> float | None:
    """The error of a method after `seconds`, interpolated in its measured curve; None long before its first picture.

    The interpolation is linear in the logarithms. Beyond the ends the nearest segment is extrapolated, with an exponent
    between that of 1/time and 0.
    """
    points = sorted((math.log(row["seconds"]), math.log(resolved(row, key))) for row in curve)
    x = math.log(seconds)
    if x < points[0][0] - math.log(2.0):
        return None
    if len(points) == 1:
        return math.exp(points[0][1] - (x - points[0][0]))
    k = min(max(sum(px < x for px, _ in points), 1), len(points) - 1)
    (x0, y0), (x1, y1) = points[k - 1], points[k]
    slope = (y1 - y0) / max(x1 - x0, 1e-9)
    if x0 <= x <= x1:
        return math.exp(y0 + slope * (x - x0))
    end = (x0, y0) if x < x0 else (x1, y1)
    return math.exp(end[1] + min(max(slope, -1.0), 0.0) * (x - end[0]))


def advantage(row: Row, rows: list[Row], peer: str, key: str = "error") -> float | None:
    """The peer's error (or FLIP) divided by ours at equal time; None if the peer has no picture by then."""
    curve = [other for other in rows if other["scene"] == row["scene"] and other["method"] == peer]
    if row[key] is None or any(other[key] is None for other in curve):
        return None
    error = error_at(curve, row["seconds"], key) if curve else None
    return None if error is None else error / resolved(row, key)


def error_tables(rows: list[Row], peers: list[str]) -> list[Table]:
    """Error against time, one table for each scene, with the ratios to the peers at equal time."""
    tables = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        chosen = [row for row in rows if row["scene"] == scene]
        lines = []
        for row in chosen:
            ratios = [advantage(row, rows, peer) if row["method"] not in peers else None for peer in peers]
            lines.append(
                (
                    row["method"],
                    number(row["budget"]),
                    number(row["seconds"]),
                    number(row["samples"]),
                    number(row["error"]),
                    f"{number(row['error_low'], 2)} … {number(row['error_high'], 2)}",
                    f"{100.0 * row['mean_ratio']:+.2f} %",
                    number(row["flip"]),
                    number(row["pattern"]),
                    *(number(ratio) for ratio in ratios),
                )
            )
        columns = ("method", "budget", "seconds", "samples", "relMSE", "spread", "mean", "FLIP", "pattern")
        columns += tuple(f"× {peer}" for peer in peers)
        note = f"The reference's own relMSE, which is subtracted: {number(chosen[0]['floor'], 2)}."
        tables.append(Table(f"{scene}: error against time", columns, lines, note))
    return tables


def overview_table(rows: list[Row], peers: list[str]) -> Table | None:
    """One row for each scene: relMSE and FLIP of the best peer divided by those of our best method, at equal time."""
    lines, ratios = [], []
    budgets = sorted({row["budget"] for row in rows})
    for scene in dict.fromkeys(row["scene"] for row in rows):
        cells: list[float | None] = []
        for budget in budgets:
            own = [r for r in rows if (r["scene"], r["budget"]) == (scene, budget) and r["method"] not in peers]
            for key in ("error", "flip"):
                by_method = [[advantage(row, rows, peer, key) for peer in peers] for row in own]
                least = [min(found) for each in by_method if (found := [x for x in each if x is not None])]
                cells.append(max(least, default=None))
        ratios.append(cells)
        lines.append((scene, *(number(cell) for cell in cells)))
    if not peers:
        return None
    for name, measure in (("median", statistics.median), ("worst", min)):
        columns = [[cell for cell in column if cell is not None] for column in zip(*ratios, strict=True)]
        lines.append((name, *(number(measure(column)) if column else "–" for column in columns)))
    header = [f"{key}, {number(budget)}" for budget in budgets for key in ("relMSE", "FLIP")]
    title = "The best peer divided by our best method, at equal time"
    return Table(title, ("scene", *header), lines, "Columns are named by the budget of our method.")


def target_table(rows: list[Row], peers: list[str]) -> Table | None:
    """The ratios of our best method to the goals, for the worst and for the best time budget."""
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == scene and row["method"] not in peers]
        for peer in peers:
            goal = TARGETS.get(scene) if peer == "mitsuba" else DENOISED_TARGET
            by_budget: dict[float, tuple[float, str]] = {}
            for row in own:
                if (ratio := advantage(row, rows, peer)) is not None:
                    best = by_budget.get(row["budget"], (0.0, ""))
                    by_budget[row["budget"]] = max(best, (ratio, row["method"]))
            if by_budget:
                low, high = min(by_budget.values()), max(by_budget.values())
                reached = "" if goal is None else ("yes" if low[0] >= goal else "no")
                methods = ", ".join(dict.fromkeys((low[1], high[1])))
                lines.append((scene, peer, number(low[0]), number(high[0]), methods, number(goal), reached))
    columns = ("scene", "peer", "worst budget", "best budget", "by", "goal", "reached")
    return Table("Error of the peers divided by ours, at equal time", columns, lines) if lines else None


def breakdown_tables(runs: list[Row]) -> list[Table]:
    """The time of our methods by phase, and their work per second; at the longest budget, over all seeds."""
    longest: dict[tuple[str, str], list[Row]] = {}
    for run in sorted(runs, key=lambda run: run["budget"]):
        chosen = longest.setdefault((run["scene"], run["method"]), [])
        if run["timings"]:
            longest[run["scene"], run["method"]] = [r for r in chosen if r["budget"] == run["budget"]] + [run]

    def sums(key: str) -> dict[tuple[str, str], dict[str, float]]:
        """Every phase or count, per second of rendering, by scene and method."""
        result = {}
        for case, group in longest.items():
            seconds = sum(run["seconds"] for run in group)
            names = dict.fromkeys(name for run in group for name in run[key])
            result[case] = {name: sum(run[key].get(name, 0.0) for run in group) / seconds for name in names}
        return {case: values for case, values in result.items() if values}

    def table(title: str, values: dict[tuple[str, str], dict[str, float]], form: str, note: str = "") -> Table:
        names = list(dict.fromkeys(name for row in values.values() for name in row))
        lines = [
            (scene, method, *(format(row[name], form) if name in row else "–" for name in names))
            for (scene, method), row in values.items()
        ]
        return Table(title, ("scene", "method", *(name.replace("_", " ") for name in names)), lines, note)

    shares = sums("timings")
    for row in shares.values():
        row["other"] = 1.0 - sum(row.values())
    return [table("Time by phase", shares, ".0%"), table("Work per second", sums("counts"), ".3g")]


def compare(new: list[Row], old: list[Row]) -> tuple[Table, bool]:
    """Time x error divided by that of an earlier result, and whether any has grown by more than `REGRESSION`.

    Times are in the units of the budgets.

    Peers are compared as well: if theirs change, the machine has changed and not the code.
    """
    earlier_rows = {(row["scene"], row["method"], row["budget"]): row for row in old}
    lines, worse = [], False
    for row in new:
        earlier = earlier_rows.get((row["scene"], row["method"], row["budget"]))
        if earlier is None:
            continue
        seconds = row["seconds"] / earlier["seconds"] * earlier.get("unit", 1.0) / row.get("unit", 1.0)
        error = resolved(row) / resolved(earlier)
        merit = seconds * error
        mark = "WORSE" if merit > REGRESSION else "better" if merit < 1.0 / REGRESSION else ""
        worse |= merit > REGRESSION
        cells = (number(row["budget"]), number(seconds), number(error), number(merit), mark)
        lines.append((row["scene"], row["method"], *cells))
    columns = ("scene", "method", "budget", "time ratio", "error ratio", "time x error", "")
    return Table("Comparison with the earlier result", columns, lines), worse
