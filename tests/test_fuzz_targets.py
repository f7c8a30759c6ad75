"""The parsers that are fuzzed (tests/fuzz_targets) keep their promise on the corpus, and on random damage of it."""

import numpy as np
import pytest

from tests.fuzz import damage
from tests.fuzz_targets.targets import TARGETS, corpus


def _try(name, count):
    rng = np.random.default_rng(0)
    inputs = corpus(name)
    for data in inputs:
        TARGETS[name](data)
    for k in range(count):
        TARGETS[name](damage(inputs[k % len(inputs)], rng))


FAST = [pytest.param(name, marks=pytest.mark.extended if name == "film" else ()) for name in TARGETS]


@pytest.mark.parametrize("name", FAST)
def test_parsers_keep_their_promise(name):
    """A parser reads sound, empty and randomly damaged input, or refuses it by the error that it promises."""
    if name == "mtlx":
        pytest.importorskip("MaterialX")
    _try(name, 10 if name in ("film", "ies") else 50)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_parsers_keep_their_promise_longer(name):
    """Thousands of damaged inputs."""
    _try(name, 3000)
