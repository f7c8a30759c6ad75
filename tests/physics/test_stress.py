"""The cases of benchmarks/stress.py, which are hard on numbers, with few seeds; the program itself takes more."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from warp_ir.estimators import ESTIMATORS

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))  # where programs find each other
import stress

LONG = ("10^5 iterations", "fireflies over iterations")
"""Cases of minutes."""
QUICK = ("albedo 0.999", "albedo 1")
CASES = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.extended) for name in stress.CASES if name not in LONG
]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("name", CASES)
def test_the_limit_is_kept(name, estimator):
    """The case's own docstring is the fact; limits of comparisons include three standard errors of theirs."""
    found = stress.CASES[name](estimator, 2)
    assert found.holds, f"{found.value:.3g} {found.what}, limit {found.limit:.3g}"


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("name", stress.CASES)
def test_the_limit_is_kept_with_more_seeds(name, estimator):
    """10⁵ iterations, and comparisons to a few percent."""
    found = stress.CASES[name](estimator, 4)
    assert found.holds, f"{found.value:.3g} {found.what}, limit {found.limit:.3g}"


def test_a_limit_can_fail():
    """A room with a hole in its wall is not dark, and a value that is no number keeps no limit."""
    assert not stress.Finding(float("nan"), 1.0, "").holds
    scene = stress.dark_room(0.0, stress.np.eye(3))
    box = scene.meshes[0]
    open_box = replace(box, triangles=box.triangles[:-2], material=box.material[:-2])
    film = stress.render(replace(scene, meshes=(open_box, *scene.meshes[1:])), "path")
    assert film.radiance().max() > 0.1
