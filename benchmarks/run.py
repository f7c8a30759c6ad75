"""Error against time of our estimators and of other renderers, for every scene with a stored reference.

    python benchmarks/run.py [-k NAME ...] [--device cpu] [--seconds 0.2 0.6 2] [--seeds 3] [--estimators NAME ...]
                             [--peers] [--json FILE] [--plot FILE.png] [--compare OLD.json] [--quick]
    python benchmarks/run.py -k 0 1 2 ... --units 0.2 0.6 2 --peers    # scenes that are made from these numbers
    python benchmarks/run.py -k 0 1 2 ... --iterations 1 2 4 8         # fixed iterations and CPU time

Methods take turns within one run, on the same cores. Compilation and upload happen before and are reported
separately. Every number is the median over seeds. Budgets are seconds, or units of a work that is measured first
(`work_unit.py`), so that slow machines and fast ones ask the same; or iterations, with the CPU time that they take,
which other load on the machine disturbs least.
"""

import argparse
import json
import statistics
import sys
from pathlib import Path
from typing import Any

import warp as wp
from analysis import breakdown_tables, compare, error_tables, overview_table, resolved, summarize, target_table
from make_references import ReferencesDisagree
from methods import Method, StaleReference, Task, load_task, own_methods, stored_tasks
from peers import find_peers
from perception import flip, pattern_peak
from report import Table, environment, number, publish
from work_unit import unit_seconds

from warp_ir.metrics import mean_ratio, relative_mse

QUICK: dict[str, Any] = {"names": ["cornell_box", "furnace_cube"], "seconds": [0.1], "seeds": 1}


PEER_SAMPLES = 16
"""Samples per pixel of a peer for an iteration of ours, where iterations are fixed: they take a similar time."""


def measure(
    task: Task, methods: list[Method], budgets: list[float], seeds: int, *, unit: float = 1.0, iterations: bool = False
) -> list[dict[str, Any]]:
    """Runs all methods in turn, for every seed and budget, and measures time and error.

    Budgets are in units of `unit` seconds, or numbers of iterations if `iterations` is set.
    """
    runs = []
    for seed in range(1, seeds + 1):
        for budget in budgets:
            for method in methods:
                if iterations:
                    count = round(budget) * (PEER_SAMPLES if method.name.startswith("mitsuba") else 1)
                    run = method.render_samples(count, seed)
                else:
                    run = method.render(budget * unit, seed)
                runs.append(
                    {
                        "scene": task.name,
                        "method": method.name,
                        "budget": budget,
                        "unit": unit,
                        "seed": seed,
                        "seconds": run.seconds,
                        "samples": run.samples,
                        "error": relative_mse(run.picture, task.reference, reference_error=task.reference_error),
                        "mean_ratio": mean_ratio(run.picture, task.reference),
                        "flip": flip(run.picture, task.reference),
                        "pattern": pattern_peak(run.picture, task.reference),
                        "floor": task.floor,
                        "timings": run.timings,
                        "counts": run.counts,
                    }
                )
    return runs


def measure_all(
    names: list[str],
    methods: list[Method],
    budgets: list[float],
    seeds: int,
    *,
    unit: float = 1.0,
    iterations: bool = False,
    **reference: Any,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], dict[str, str]]:
    """The runs of all scenes, the seconds of their preparation, and what was skipped with the reason.

    `reference` says how references of random scenes are made, as in `load_task`.
    """
    runs, setup, skipped = [], [], {}
    for name in names:
        try:
            task = load_task(name, **reference)
        except (ReferencesDisagree, StaleReference) as error:
            skipped[name] = str(error)
            continue
        prepared = []
        for method in methods:
            try:
                steps = method.prepare(task, [budget * unit for budget in budgets])
                setup.append({"scene": name, "method": method.name, **steps})
                prepared.append(method)
            except NotImplementedError as error:
                skipped[f"{method.name} on {name}"] = str(error)
        print(f"{name}: {', '.join(method.name for method in prepared)}", file=sys.stderr, flush=True)
        runs += measure(task, prepared, budgets, seeds, unit=unit, iterations=iterations)
    return runs, setup, skipped


def setup_table(setup: list[dict[str, Any]]) -> Table:
    """Compile and upload time of each method: the median over the scenes and the longest."""
    lines = []
    for method in dict.fromkeys(row["method"] for row in setup):
        chosen = [row for row in setup if row["method"] == method]
        cells = []
        for step in ("compile", "upload"):
            seconds = [row[step] for row in chosen]
            cells += [number(statistics.median(seconds)), number(max(seconds))]
        lines.append((method, *cells))
    columns = ("method", "compile s, median", "longest", "upload s, median", "longest")
    note = "Kernels may come from the cache; the compile time of the peers includes their probe renders."
    return Table("Preparation, not part of the measured time", columns, lines, note)


def plot(rows: list[dict[str, Any]], path: Path, title: str) -> None:
    """Plots error against seconds on logarithmic axes, one panel for each scene; bars show the range over the seeds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    budgets = sorted({row["budget"] * row["unit"] for row in rows})
    columns = min(len(scenes), 4)
    lines = -(-len(scenes) // columns)
    figure, panels = plt.subplots(
        lines, columns, figsize=(4 * columns, 3.4 * lines), squeeze=False, layout="constrained"
    )
    for panel in panels.flat[len(scenes) :]:
        panel.set_visible(False)
    for panel, scene in zip(panels.flat, scenes, strict=False):
        for k, method in enumerate(methods):
            curve = sorted(
                (row for row in rows if row["scene"] == scene and row["method"] == method),
                key=lambda row: row["seconds"],
            )
            medians = [resolved(row) for row in curve]
            below = [m - min(resolved(row, "error_low"), m) for m, row in zip(medians, curve, strict=True)]
            above = [resolved(row, "error_high") - m for m, row in zip(medians, curve, strict=True)]
            style = "--" if method.startswith("mitsuba") else "-"
            seconds = [row["seconds"] for row in curve]
            panel.errorbar(seconds, medians, [below, above], fmt=f"o{style}", color=f"C{k}", label=method, ms=3)
        floor = next(row["floor"] for row in rows if row["scene"] == scene)
        panel.axhline(floor, color="0.7", lw=0.8, ls=":")
        panel.set(xscale="log", yscale="log", title=scene, xlabel="seconds", ylabel="relMSE")
        panel.set_xticks(budgets, [f"{budget:g}" for budget in budgets])
        panel.xaxis.set_minor_formatter(NullFormatter())
        left, right = panel.get_xlim()
        panel.set_xlim(min(left, 0.5 * budgets[0]), max(right, 2.0 * budgets[-1]))
    handles, labels = panels.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.suptitle(title, fontsize="small")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Parses the command line, checks its names and fills in the defaults."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "-k",
        dest="names",
        nargs="+",
        metavar="NAME",
        help="scenes with a stored reference, or numbers of random scenes (default: all with a reference)",
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda:N")
    budgets = parser.add_mutually_exclusive_group()
    budgets.add_argument("--seconds", type=float, nargs="+", help="time budgets (default: 0.2 0.6 2)")
    budgets.add_argument("--units", type=float, nargs="+", help="time budgets in units of a measured work")
    budgets.add_argument("--iterations", type=int, nargs="+", help="numbers of iterations; CPU time is measured")
    parser.add_argument("--seeds", type=int, help="number of seeds (default: 3)")
    parser.add_argument("--size", type=int, default=96, help="width of the pictures of random scenes (default: 96)")
    parser.add_argument(
        "--reference-seconds",
        type=float,
        default=240.0,
        help="CPU time for the reference of a random scene that is not in benchmarks/cache yet (default: 240)",
    )
    parser.add_argument("--estimators", nargs="+", metavar="NAME", help="our methods to run (default: all)")
    parser.add_argument("--peers", action="store_true", help="also measure other renderers that are installed")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="plot error against time")
    parser.add_argument(
        "--compare",
        type=Path,
        metavar="OLD.json",
        help="compare with this result; exit code 1 if time x error has grown",
    )
    parser.add_argument(
        "--quick", action="store_true", help="two scenes, 0.1 s, one seed: to check that the program runs"
    )
    options = parser.parse_args(arguments)
    defaults = QUICK if options.quick else {"names": stored_tasks(), "seconds": [0.2, 0.6, 2.0], "seeds": 3}
    for name, value in defaults.items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    if unknown := sorted({name for name in options.names if not name.isdecimal()} - set(stored_tasks())):
        parser.error(f"no reference for {', '.join(unknown)}; there are {', '.join(stored_tasks())}")
    known = own_methods(options.device)
    if unknown := sorted(set(options.estimators or known) - set(known)):
        parser.error(f"no estimator {', '.join(unknown)}; there are {', '.join(known)}")
    options.own = [known[name] for name in options.estimators or known]
    return options


def main(arguments: list[str] | None = None) -> int:
    """Measures and reports; returns 1 if a result is worse than the earlier one."""
    options = parse(arguments)
    wp.config.log_level = wp.LOG_WARNING
    peers, missing = find_peers(options.device) if options.peers else ({}, {})
    methods = [*options.own, *peers.values()]
    budgets = options.iterations or options.units or options.seconds
    unit = unit_seconds(options.device) if options.units else 1.0
    runs, setup, skipped = measure_all(
        options.names,
        methods,
        budgets,
        options.seeds,
        unit=unit,
        iterations=options.iterations is not None,
        size=options.size,
        reference_seconds=options.reference_seconds,
    )
    for name, reason in {**missing, **skipped}.items():
        print(f"skipped {name}: {reason}", file=sys.stderr)
    if not runs:
        return 1
    rows = summarize(runs)
    results = {
        "environment": environment(options.device),
        "settings": {method.name: method.choices for method in options.own},
        "budgets": budgets,
        "budgets_are": "iterations" if options.iterations else "units" if options.units else "seconds",
        "unit_seconds": unit,
        "seeds": options.seeds,
        "skipped": {**missing, **skipped},
        "rows": rows,
        "setup": setup,
        "runs": runs,
    }
    tables = [
        *error_tables(rows, list(peers)),
        overview_table(rows, list(peers)),
        target_table(rows, list(peers)),
        *breakdown_tables(runs),
        setup_table(setup),
    ]
    worse = False
    if options.compare is not None:
        old = json.loads(options.compare.read_text())
        old_rows = [row for part in (old, old.get("error", {}), old.get("random", {})) for row in part.get("rows", [])]
        table, worse = compare(rows, old_rows)
        tables.append(table)
    present = [table for table in tables if table is not None]
    publish(present, results, json_path=options.json, markdown_path=options.markdown)
    if options.plot is not None:
        plot(rows, options.plot, f"{results['environment']['device_name']}, {results['environment']['commit']}")
    return int(worse)


if __name__ == "__main__":
    sys.exit(main())
