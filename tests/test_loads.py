"""Large loads take what is predicted before anything is allocated; minutes, and up to 12 GB of memory, each."""

import sys
from pathlib import Path

import pytest

from warp_ir.memory import available_memory

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))  # where programs find each other
import loads

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", loads.LOADS)
def test_memory_is_what_is_predicted(name):
    """What stays is within a fifth of the estimate, and the peak no more than what is required up front.

    64 MiB are what allocators keep.
    """
    if available_memory() < 14e9:
        pytest.skip("less than 14 GB are free")
    found = loads.run(name)
    assert found["resident"] < 1.2 * found["predicted"] + 2**26
    assert found["peak"] < 1.2 * found["predicted_peak"] + 2**26


def test_nothing_grows():
    """A thousand renders, and a thousand updates, leave the process as large as it was: within 1 kB each."""
    found = loads.run("steady")
    assert max(found.values()) < 1000 * 1024
