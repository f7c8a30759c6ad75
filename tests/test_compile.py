"""Compiling the kernels: how much there is of it, and that it is done once."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

STAGE = Path(__file__).parents[1] / "scenes_usd" / "furnace_cube.usda"
_RENDER = "import sys; from warp_ir.cli import main; sys.exit(main(sys.argv[1:]))"
_TRIVIAL = """
import warp as wp
@wp.kernel
def fill(out: wp.array[wp.float32]):
    out[wp.tid()] = 1.0
"""


def cpu_seconds(command, cache, **keywords):
    """CPU time of a process with a kernel cache of its own."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache)}
    subprocess.run(command, env=environment, check=True, capture_output=True, **keywords)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before


_EVERYTHING = """#usda 1.0
( upAxis = "Y"
  startTimeCode = 0
  endTimeCode = 1 )
def Camera "Camera" {
    float focalLength = 35
    float fStop = 4
    float focusDistance = 6
    double shutter:close = 0.5
    double3 xformOp:translate = (0, 1, 6)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def DistantLight "Sun" {}
def Cube "Moving" {
    double3 xformOp:translate.timeSamples = { 0: (-1, 0, 0), 1: (1, 0, 0) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""
"""Light from far away, a lens, and what moves while the shutter is open: all that is compiled for some scenes alone."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "estimator, iterations, most", [("vpl", 1, 12.0), ("keller", 1, 12.0), ("path", 1, 12.0), ("vpl", 5, 18.5)]
)
def test_cold_start(tmp_path, estimator, iterations, most):
    """A first render compiles every module once, in the time of some trivial ones; a second one compiles nothing.

    A trivial kernel is mostly Warp's headers, which every compiling thread reads once. Twelve are 16 s of CPU time
    where one takes 1.3 s, and 8 s on two cores. A scene that needs everything takes 10.5 s there, and 17 of them; a
    little room is left, because large modules suffer more than small ones if the machine is busy.
    """
    module = tmp_path / "trivial.py"
    module.write_text(_TRIVIAL)
    load = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import warp, trivial; warp.load_module(trivial, 'cpu')"
    python = [sys.executable, "-c"]
    trivial = [cpu_seconds([*python, load], tmp_path / "trivial") for _ in range(2)]  # compiled, and from the cache
    cache, stage = tmp_path / "cache", STAGE
    if iterations > 1:
        stage = tmp_path / "everything.usda"
        stage.write_text(_EVERYTHING)
    flags = ["--width=16", "--height=16", f"--iterations={iterations}", f"--estimator={estimator}", "--quiet"]
    command = [*python, _RENDER, "render", str(stage), str(tmp_path / "out.exr"), *flags]
    cold = cpu_seconds(command, cache)
    compiled = sorted(cache.rglob("*.o"))
    names = [path.name.rsplit("_", 1)[0] for path in compiled]
    assert len(names) == len(set(names)) > 3  # neither twice nor in two variants
    assert any("blur" in name for name in names) == (iterations > 1)
    written = [path.stat().st_mtime_ns for path in compiled]
    warm = cpu_seconds(command, cache)
    assert sorted(cache.rglob("*.o")) == compiled and [path.stat().st_mtime_ns for path in compiled] == written
    assert cold - warm <= most * (trivial[0] - trivial[1])
