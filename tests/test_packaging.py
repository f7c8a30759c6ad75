"""What a user meets first: the README's test command, imports that cost nothing, links, the project's files."""

import os
import re
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import pytest

import warp_ir

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def fresh(code):
    """Standard output of a program in a new interpreter in which warnings are errors."""
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT, timeout=60).stdout


def test_version_is_the_same_everywhere():
    """The package alone holds the version: the metadata take it from there, and the changelog agrees."""
    assert 'version = { attr = "warp_ir.__version__" }' in PROJECT.splitlines()
    assert 'dynamic = ["version"]' in PROJECT.splitlines() and 'version = "' not in PROJECT
    assert f"## [{warp_ir.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_readme_test_command_runs_in_ci():
    """The CI script finds exactly one line to run, and it does the whole set-up."""
    commands = [line for line in README.splitlines() if line.endswith("python -m pytest")]
    assert len(commands) == 1 and commands[0].startswith("python3 -m venv .venv && .venv/bin/pip install ")
    script = ROOT / ".ci" / "run"
    assert "grep -m 1 'python -m pytest$' README.md" in script.read_text(encoding="utf-8")
    assert os.access(script, os.X_OK)


DOCUMENTS = sorted(
    str(path.relative_to(ROOT))
    for folder in (".", "docs", "docs/design", "benchmarks")
    for path in ROOT.glob(f"{folder}/*.md")
)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_links_lead_somewhere(name):
    """Every relative link is a file, pictures included."""
    path = ROOT / name
    links = re.findall(r"\]\((?!http)([^)#]+)\)", path.read_text(encoding="utf-8"))
    assert [to for to in links if not (path.parent / to).exists()] == []


@pytest.mark.parametrize("name", [name for name in DOCUMENTS if name.startswith("docs/design/")])
def test_decisions_are_held_by_what_exists(name):
    """Every decision has its four parts, and the tests and files that a page names are there."""
    text = (ROOT / name).read_text(encoding="utf-8")
    for file, test in re.findall(r"(tests/[\w/]+\.py)::(\w+)", text):
        assert f"def {test}(" in (ROOT / file).read_text(encoding="utf-8"), f"{file}::{test}"
    paths = re.findall(r"`([\w/]+/[\w]+\.(?:py|md))`", text)
    assert [path for path in paths if not (ROOT / path).exists() and not (ROOT / "warp_ir" / path).exists()] == []
    decisions = [part for part in text.split("\n## ")[1:] if not part.startswith("Known limits")]
    parts = "**Context.**", "**Decision.**", "**What it costs.**", "**Held by.**"
    assert all(part in decision for decision in decisions for part in parts)


def test_pictures_are_small():
    """A clone stays light."""
    pictures = list((ROOT / "docs" / "pictures").iterdir())
    assert {"cornell_box.png", "vpls.png"} <= {path.name for path in pictures}
    assert [path.name for path in pictures if path.stat().st_size > 300_000] == []


def test_import_is_light():
    """`import warp_ir` imports neither Warp nor USD nor NumPy, nor anything that draws or reads pictures."""
    heavy = "warp", "pxr", "numpy", "pyvista", "vtk", "OpenImageIO", "rich", "matplotlib", "scipy"
    code = f"import sys, warp_ir; print([name for name in {heavy} if name in sys.modules])"
    assert fresh(code).strip() == "[]"
    code = "import time; begin = time.process_time(); import warp_ir; print(time.process_time() - begin)"
    assert float(fresh(code)) < 0.15  # seconds of CPU time


def test_every_public_name_exists():
    """All names that the package promises can be had, and unknown ones are an AttributeError."""
    for name in warp_ir.__all__:
        assert getattr(warp_ir, name) is not None
    assert set(warp_ir.__all__) < set(dir(warp_ir))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = warp_ir.nothing


def test_license_is_complete():
    """The license that pyproject.toml names is there in full."""
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert 'license = "Apache-2.0"' in PROJECT.splitlines()
    assert "TERMS AND CONDITIONS FOR USE, REPRODUCTION, AND DISTRIBUTION" in text
    assert "END OF TERMS AND CONDITIONS" in text


def test_the_archive_of_the_sources_has_what_its_tests_need():
    """Every folder beside the package is in MANIFEST.in, but for that of GitHub, and so is every document."""
    manifest = (ROOT / "MANIFEST.in").read_text(encoding="utf-8")
    grafted = {line.split()[1] for line in manifest.splitlines() if line.startswith("graft")}
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if tracked.returncode or not tracked.stdout:
        pytest.skip("not a checkout")
    folders = {line.split("/")[0] for line in tracked.stdout.splitlines() if "/" in line}
    assert folders - {"warp_ir", ".github"} == grafted
    files = {line for line in tracked.stdout.splitlines() if "/" not in line}
    (included,) = (line.split()[1:] for line in manifest.splitlines() if line.startswith("include"))
    by_setuptools = {"LICENSE", "pyproject.toml", "MANIFEST.in"}
    assert all(any(fnmatch(file, pattern) for pattern in included) for file in files - by_setuptools)


def test_entry_point_is_the_command():
    """`warp-ir` and `python -m warp_ir` are the same."""
    from warp_ir.__main__ import command

    assert 'warp-ir = "warp_ir.__main__:command"' in PROJECT.splitlines() and callable(command)
