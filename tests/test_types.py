"""Users' type checkers see the public names: mypy --strict accepts the documented program and rejects ten misuses."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import warp_ir as ir

ROOT = Path(__file__).parent.parent
PROGRAM = "\n".join(
    re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), flags=re.DOTALL)
)
"""The examples of docs/api.md, one after the other."""
MISUSES = {
    "ir.render(scene, widht=3)": "call-arg",
    "ir.load_usd('room.usda', complexty='high')": "call-arg",
    "ir.RenderSettings(width='wide')": "arg-type",
    "ir.RenderSettings(512)": "call-arg",
    "ir.Renderer()": "call-arg",
    "film.radiance().shap": "attr-defined",
    "film.aov()": "call-arg",
    "ir.write_image(film, 'room.png')": "arg-type",
    "ir.trace_vpls(scene).position": "attr-defined",
    "settings.width = 3": "misc",
    "ir.rendr(scene)": "attr-defined",
    "ir.Camera.look_at(eye=(0, 0, 1), target=1.0)": "arg-type",
}
"""Statements that are wrong, and mypy's code for each; `scene`, `film` and `settings` are what they seem."""
CONFIG = "[mypy]\nfollow_imports = silent\n[mypy-OpenImageIO.*,pyvista.*,vtk.*,pxr.*]\nignore_missing_imports = True\n"


def check(tmp_path, text):
    """The lines of a program that mypy --strict complains about, with the code of each complaint."""
    (tmp_path / "program.py").write_text(text, encoding="utf-8")
    (tmp_path / "mypy.ini").write_text(CONFIG, encoding="utf-8")
    cache = tmp_path / "cache"
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file=mypy.ini", f"--cache-dir={cache}", "program.py"]
    # An editable installation is not on mypy's path.
    environment = {**os.environ, "MYPYPATH": str(ROOT)}
    out = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=300)
    assert out.returncode in (0, 1), out.stdout + out.stderr
    return re.findall(r"^program\.py:(\d+): error: .*\[([a-z-]+)\]$", out.stdout, flags=re.MULTILINE)


@pytest.mark.extended
def test_type_checkers_see_every_public_name(tmp_path):
    """The documented program, which uses every public name, has no type errors; misspelt and wrong uses have."""
    assert all(f"ir.{name}" in PROGRAM for name in ir.__all__)
    setup = "def misuse(scene: ir.Scene, film: ir.Film, settings: ir.RenderSettings) -> None:\n"
    text = PROGRAM + "\n\n" + setup + "".join(f"    {statement}\n" for statement in MISUSES)
    lines = text.splitlines()
    errors = {lines[int(line) - 1].strip(): code for line, code in check(tmp_path, text)}
    assert errors == MISUSES
