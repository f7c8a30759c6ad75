"""Scratch arrays belong to one owner, grow when they must, and keep their dtype."""

import numpy as np
import pytest
import warp as wp

from warp_ir.device.scratch import Scratch


def test_arrays_stay(launcher):
    """A name gives the same array until it needs more rows; other names, and other owners, have others."""
    scratch = Scratch(launcher)
    first = scratch.array("a", 10, wp.int32)
    assert scratch.array("a", 5, wp.int32) is first and scratch.array("b", 10, wp.int32) is not first
    assert Scratch(launcher).array("a", 10, wp.int32) is not first
    assert scratch.array("a", 100, wp.int32).shape[0] >= 100


def test_dtypes_are_checked(launcher):
    """Asking for another dtype under a name that is taken is an error, not the wrong array."""
    scratch = Scratch(launcher)
    scratch.array("a", 10, wp.int32)
    with pytest.raises(TypeError, match=r"scratch array 'a' has dtype .*int32.*, not .*float32"):
        scratch.array("a", 10, wp.float32)


def test_uploads_are_repeated_only_for_other_data(launcher):
    """Equal data are not uploaded again; different data are."""
    scratch = Scratch(launcher)
    first = scratch.upload("a", np.arange(4, dtype=np.int32), wp.int32)
    assert scratch.upload("a", np.arange(4, dtype=np.int32), wp.int32) is first
    second = scratch.upload("a", np.arange(5, dtype=np.int32), wp.int32)
    assert second is not first and second.numpy().tolist() == [0, 1, 2, 3, 4]
