"""Runs `run.py`, `rays.py` and `scaling.py` on one or more devices; the results go to `benchmarks/results/`.

    python scripts/run_benchmarks.py --device cpu [--device cuda:0] [--scenes 0 1 ...] [--quick]

`run.py` runs on the stored scenes, and on ten random ones with budgets in units of a measured work. For each device:
`<device>.json` (all numbers), `<device>.md` (the tables) and `<device>.png` (error against time, stored scenes).
Run nothing else on the machine meanwhile.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
QUESTIONS = {"error": "run.py", "random": "run.py", "rays": "rays.py", "scaling": "scaling.py"}


def run(device: str, results: Path, scenes: list[str], quick: bool) -> None:
    """Runs all questions on one device, each in a separate process."""
    stem = results / device.replace(":", "")
    numbers, tables = {}, [f"# Benchmarks on {device}\n\n![error against time]({stem.name}.png)\n"]
    with tempfile.TemporaryDirectory() as scratch:
        for question, script in QUESTIONS.items():
            json_file, markdown_file = Path(scratch, "numbers.json"), Path(scratch, "tables.md")
            command = [sys.executable, BENCHMARKS / script, "--device", device]
            command += ["--json", json_file, "--markdown", markdown_file]
            if question == "error":
                command += ["--plot", stem.with_suffix(".png"), *(["--quick"] if quick else ["--peers"])]
            elif question == "random":
                few = ["-k", *scenes[:1], "--units", "0.1", "--seeds", "1", "--size", "32", "--reference-seconds", "5"]
                command += few if quick else ["-k", *scenes, "--units", "0.2", "0.6", "2", "--peers"]
            elif quick:
                command += ["--quick"]
            subprocess.run(command, check=True)
            numbers[question] = json.loads(json_file.read_text())
            tables.append(markdown_file.read_text())
    stem.with_suffix(".json").write_text(json.dumps(numbers, indent=1) + "\n")
    stem.with_suffix(".md").write_text("\n".join(tables))
    print(f"wrote {stem}.json, .md and .png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--device", dest="devices", action="append", help="cpu, cuda:0, ...; may be repeated (default: cpu)"
    )
    parser.add_argument("--results", type=Path, default=BENCHMARKS / "results", help="folder to write to")
    parser.add_argument(
        "--scenes",
        nargs="+",
        default=[str(seed) for seed in range(10)],
        help="random scenes (default: 0 to 9)",
    )
    parser.add_argument(
        "--quick", action="store_true", help="short runs without peers: a minute instead of a quarter of an hour"
    )
    options = parser.parse_args()
    options.results.mkdir(parents=True, exist_ok=True)
    for device in options.devices or ["cpu"]:
        run(device, options.results, options.scenes, options.quick)


if __name__ == "__main__":
    main()
