"""Kernels on many threads: the same result, and an end when asked."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from warp_ir.device import definitions
from warp_ir.device.compiling import ModuleLoader
from warp_ir.device.launcher import Cancelled, Launcher
from warp_ir.film import accumulate
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


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_overlapped_launches_are_done_when_the_block_ends(threads):
    """Overlapped launches and those in the block all run, every index exactly one time."""
    launcher = Launcher("cpu", threads)
    overlapped, inside = launcher.zeros(5000, wp.int32), launcher.zeros(5000, wp.int32)
    for count in (1, 300, 5000, 5000, 5000):  # bands are cut by what earlier launches have taken
        overlapped.zero_(), inside.zero_()
        with launcher.overlap("overlap", lambda count=count: launcher.launch(_square, count, [overlapped])):
            for begin in (0, count // 2):
                part = count // 2 if begin == 0 else count - begin
                launcher.launch(_square, part, [inside[begin:]])
        expected = np.arange(count, dtype=np.int32) ** 2
        np.testing.assert_array_equal(overlapped.numpy()[:count], expected)
        np.testing.assert_array_equal(inside.numpy()[: count // 2], expected[: count // 2])
        np.testing.assert_array_equal(inside.numpy()[count // 2 : count], expected[: count - count // 2])
    assert launcher.profile.seconds()["overlap"] > 0.0


@pytest.mark.parametrize("threads", [1, 3])
def test_overlapped_launches_end_with_the_block(threads):
    """An error in the block, or `cancel`, leaves no launch behind that would go on writing."""
    launcher = Launcher("cpu", threads)
    out = launcher.zeros(100_000, wp.int32)

    def start():
        launcher.launch(_square, 100_000, [out])

    with pytest.raises(ZeroDivisionError), launcher.overlap("overlap", start):
        raise ZeroDivisionError
    np.testing.assert_array_equal(out.numpy()[:1000], np.arange(1000, dtype=np.int32) ** 2)
    with pytest.raises(Cancelled), launcher.overlap("overlap", start):
        launcher.cancel()
    out.zero_()
    launcher.resume()
    launcher.launch(_square, 1, [launcher.zeros(1, wp.int32)])
    assert out.numpy().max() == 0


def test_uninterruptible_launches_run_to_their_end():
    """What must be done entirely or not at all is done in spite of `cancel`, which takes effect after it."""
    launcher = Launcher("cpu", 2)
    out = launcher.zeros(1000, wp.int32)
    launcher.cancel()
    with launcher.uninterruptible():
        launcher.launch(_square, 1000, [out])
    np.testing.assert_array_equal(out.numpy(), np.arange(1000, dtype=np.int32) ** 2)
    with pytest.raises(Cancelled):
        launcher.launch(_square, 1000, [out])


def test_errors_of_a_launch_are_raised():
    """A launch that cannot be packed raises where it is made, and leaves the launcher as it was."""
    launcher = Launcher("cpu", 2)
    out = launcher.zeros(1000, wp.int32)
    with pytest.raises(RuntimeError, match="expects an array"):
        launcher.launch(_square, 1000, [3.0])
    launcher.launch(_square, 1000, [out])
    np.testing.assert_array_equal(out.numpy(), np.arange(1000, dtype=np.int32) ** 2)


def test_unknown_device_is_named():
    """A device that is not there is an input error that lists those that are."""
    with pytest.raises(InputError, match=r"cuda:99.*available: cpu"):
        Launcher("cuda:99")


def test_compiling_is_reported(monkeypatch, caplog):
    """What the kernel cache lacks is reported when it begins, after each module, and in the end; the rest is silent."""
    monkeypatch.setattr(wp, "load_module", lambda *_, **__: None)
    monkeypatch.setattr(definitions, "load", lambda module: module.startswith("recorded"))
    monkeypatch.setattr(definitions, "record", lambda *_: None)
    monkeypatch.setattr(ModuleLoader, "_load_cached", lambda self, module: module.startswith("cached"))
    monkeypatch.setattr(ModuleLoader, "_path", lambda self, module: "no such file")
    loader = ModuleLoader(wp.get_device("cpu"), 64)
    with caplog.at_level(logging.INFO, "warp_ir"):
        loader.load("cached 1")
        loader.load("recorded")
        assert not caplog.records
        loader.expect(["cached 2", "new 1", "new 2"])
        for module in ("new 1", "cached 2", "new 2", "new 1"):
            loader.load(module)
    assert [getattr(record, "compiling", None) for record in caplog.records] == [(0, 3), (1, 3), (2, 2), None]
    assert caplog.messages[0] == "compiling kernels, once: 0 of 3 modules done"
    assert caplog.messages[-1].startswith("kernels compiled: 2 modules, ")


def test_kernel_cache_is_known(launcher):
    """A module that has been loaded lies in the cache where the loader looks for it; one with another text does not."""
    loader = ModuleLoader(launcher.device, 64)
    definitions.define_all()
    launcher.load([accumulate])
    module = wp.get_module(accumulate.__name__)
    assert loader._load_cached(module)
    other = SimpleNamespace(
        get_module_identifier=lambda block_dim: module.get_module_identifier(block_dim) + "0",
        _get_compile_output_name=module._get_compile_output_name,
        _get_meta_name=module._get_meta_name,
    )
    assert not loader._load_cached(other)
