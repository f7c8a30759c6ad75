"""Kernels on many threads: the same result, and an end when asked."""

import numpy as np
import pytest
import warp as wp

from warp_ir.launch import Cancelled, Launcher
from warp_ir.scene import InputError

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _square(first: int, out: wp.array[wp.int32]):
    i = first + wp.tid()
    out[i] = i * i


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 7, 255, 256, 10_000])
def test_every_index_runs_once(threads, count):
    """Whatever the bands, index i computes i², for every i."""
    launcher = Launcher("cpu", threads)
    out = launcher.zeros(max(count, 1), wp.int32)
    launcher.launch(_square, count, [out])
    np.testing.assert_array_equal(out.numpy()[:count], np.arange(count, dtype=np.int32) ** 2)


def test_cancel_abandons():
    """After `cancel`, a launch raises instead of running."""
    launcher = Launcher("cpu", 2)
    launcher.cancel()
    out = launcher.zeros(1000, wp.int32)
    with pytest.raises(Cancelled):
        launcher.launch(_square, 1000, [out])
    assert out.numpy().max() == 0


def test_kept_arrays_stay():
    """A name gives the same array until it needs more rows, and other names give others."""
    launcher = Launcher("cpu", 1)
    first = launcher.kept("a", 10, wp.int32)
    assert launcher.kept("a", 5, wp.int32) is first and launcher.kept("b", 10, wp.int32) is not first
    assert launcher.kept("a", 100, wp.int32).shape[0] >= 100


def test_unknown_device_is_named():
    """A device that is not there is an input error that lists those that are."""
    with pytest.raises(InputError, match=r"cuda:99.*available: cpu"):
        Launcher("cuda:99")
