"""The examples run, and write the pictures that they promise."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = {
    "falling_bodies": (["--frames", "2", "--size", "32"], ["falling_000.png", "falling_001.png"], ["newton"]),
    "dataset": (["--worlds", "9", "--size", "16"], ["dataset.npz", "dataset.png"], ["newton"]),
    "usd_room": (["--frames", "2", "--size", "32"], ["room_000.png", "room_001.png"], []),
    # Newton's solver for cloth takes minutes to compile.
    "cloth": (["--frames", "2", "--size", "32"], ["cloth_000.png", "cloth_001.png"], ["newton"]),
    "observations": (["--worlds", "2", "--steps", "2"], [], ["newton", "torch"]),
}
SLOW = {"cloth"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else pytest.mark.extended) for n in EXAMPLES]
)
def test_example_runs(name, tmp_path):
    """A user who runs an example gets its pictures."""
    flags, files, modules = EXAMPLES[name]
    for module in modules:
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"needs {module}")
    out = ["--out", str(tmp_path)] if files else []
    command = [sys.executable, str(ROOT / "examples" / f"{name}.py"), *flags, *out]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(files)


def test_every_example_is_run_and_listed():
    """The tests and the README of the folder name every example, and no other."""
    names = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))
    assert names == sorted(EXAMPLES)
    text = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    assert all(f"`{name}.py`" in text for name in names)
