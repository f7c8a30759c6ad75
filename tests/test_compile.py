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


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["vpl", "keller", "path"])
def test_cold_start(tmp_path, estimator):
    """A first render compiles every module once, in the time of fifteen trivial ones; a second one compiles nothing.

    A trivial kernel is mostly Warp's headers, which every compiling thread reads once. Fifteen are 20 s of CPU time
    where one takes 1.3 s, and 10 s on two cores: what a user may have to wait.
    """
    module = tmp_path / "trivial.py"
    module.write_text(_TRIVIAL)
    load = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import warp, trivial; warp.load_module(trivial, 'cpu')"
    python = [sys.executable, "-c"]
    trivial = [cpu_seconds([*python, load], tmp_path / "trivial") for _ in range(2)]  # compiled, and from the cache
    cache = tmp_path / "cache"
    flags = ["--width=16", "--height=16", "--iterations=1", f"--estimator={estimator}", "--quiet"]
    command = [*python, _RENDER, "render", str(STAGE), str(tmp_path / "out.exr"), *flags]
    cold = cpu_seconds(command, cache)
    compiled = sorted(cache.rglob("*.o"))
    names = [path.name.rsplit("_", 1)[0] for path in compiled]
    assert len(names) == len(set(names)) > 3  # neither twice nor in two variants
    written = [path.stat().st_mtime_ns for path in compiled]
    warm = cpu_seconds(command, cache)
    assert sorted(cache.rglob("*.o")) == compiled and [path.stat().st_mtime_ns for path in compiled] == written
    assert cold - warm <= 15.0 * (trivial[0] - trivial[1])
