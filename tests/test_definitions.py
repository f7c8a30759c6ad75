"""Kernels that Warp reads only where it has to compile them: the picture is the same, and nothing has been read."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

import warp_ir
from warp_ir.device import definitions

_RENDER = """
import sys
import warp_ir
import warp_ir.device.definitions as definitions
if sys.argv[1] == "by Warp":
    definitions._WARP = ""
scene = warp_ir.load_usd(sys.argv[2])
film = warp_ir.render(scene, warp_ir.RenderSettings(width=16, height=16, iterations=1))
print(hash(film.radiance().tobytes()), len(definitions._pending), len(definitions._code))
"""
STAGE = Path(__file__).parents[1] / "scenes_usd" / "cornell_box.usda"


def render(by):
    """The hash of a picture, the number of definitions that were not needed, and of modules loaded without Warp."""
    environment = {**os.environ, "PYTHONHASHSEED": "0"}
    command = [sys.executable, "-c", _RENDER, by, str(STAGE)]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return tuple(map(int, done.stdout.splitlines()[-1].split()))


def test_this_version_of_warp_is_known():
    """Without this a start is slow again; see what `definitions` calls of Warp before changing `_WARP`."""
    assert definitions._WARP == wp.__version__


@pytest.mark.extended
def test_second_start_reads_no_kernel():
    """Code is loaded by its record without a definition; the picture has the bits of Warp's own way."""
    render("by record")  # writes the records, if this is the first run since the package has changed
    picture, pending, loaded = render("by record")
    assert pending > 300 and loaded > 5
    assert render("by Warp") == (picture, 0, 0)


def test_functions_are_put_off():
    """A function is defined when it is called, or asked for anything; it is then one of Warp's like any other."""
    defined = []

    def square(x: float) -> float:
        return x * x

    square.__module__ = f"{warp_ir.__name__}.{__name__}"

    def define():
        defined.append(square)
        return wp.func(square)

    function = definitions._Function(square, define)
    assert isinstance(function, wp.Function) and function.__name__ == "square" and not defined
    assert function(3.0) == 9.0 and function.key and len(defined) == 1
    assert type(function) is wp.Function and function.module.functions[function.key] is function
