"""The cache of compiled kernels is a folder that anyone may damage, fill or take away: the kernels run all the same."""

import logging
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

import warp_ir as ir
from warp_ir.device import compiling
from warp_ir.device.compiling import ModuleLoader

pytestmark = pytest.mark.extended


@wp.kernel(enable_backward=False)
def _double(numbers: wp.array[wp.int32]) -> None:
    i = wp.tid()
    numbers[i] = 2 * numbers[i]


MODULE = wp.get_module(__name__)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty kernel cache."""
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    monkeypatch.setattr(compiling.tempfile, "tempdir", str(tmp_path))
    return folder


def run():
    """Loads the kernel anew, as a new process would, and runs it."""
    MODULE.unload()
    ModuleLoader(wp.get_device("cpu"), 64).load(MODULE)
    numbers = wp.array([1, 2], dtype=wp.int32, device="cpu")
    wp.launch(_double, dim=2, inputs=[numbers], device="cpu")
    assert numbers.numpy().tolist() == [2, 4]


def files(cache, ending):
    """The files in a cache whose names end so."""
    return sorted(path for path in cache.glob("*/*") if path.name.endswith(ending))


def cut(path, size):
    path.write_bytes(path.read_bytes()[:size])


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)


def test_what_is_damaged_is_compiled_again(cache, caplog):
    """Objects that are empty, cut or changed, with and without a note of their checksum, and cut descriptions."""
    caplog.set_level(logging.INFO, "warp_ir")

    def compiled():
        count = caplog.text.count("kernels compiled: 1 modules")
        caplog.clear()
        return count == 1

    run()
    assert compiled()
    run()
    assert not compiled()
    (binary,) = files(cache, ".o")
    whole = binary.stat().st_size
    for ending, damage in (
        (".o", lambda path: cut(path, 0)),
        (".o", lambda path: cut(path, 100)),
        (".o", lambda path: cut(path, whole - 1)),
        (".o", flip),
        (".o", lambda path: path.write_bytes(bytes(whole))),
        (".meta", lambda path: cut(path, 5)),
        (".meta", os.unlink),
        (".blake2b", lambda path: cut(path, 0)),
    ):
        damage(*files(cache, ending))
        run()
        assert compiled(), ending
        run()
        assert not compiled(), ending
    for size in (0, 100, whole - 1):
        os.unlink(*files(cache, ".blake2b"))
        cut(binary, size)
        run()
        assert compiled(), size


def _is_elsewhere(cache, caplog):
    """Whether the kernels have moved to another folder, and one warning has said so."""
    (record,) = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert "cannot be written" in record.message and "WARP_CACHE_PATH" in record.message
    return Path(wp.config.kernel_cache_dir) != cache


def test_a_folder_that_is_none_is_replaced(cache, caplog):
    """A file lies where the cache was: kernels are compiled in another folder, and that is said once."""
    run()
    cache.rename(cache.with_name("old"))
    cache.write_text("in the way")
    run()
    run()
    assert _is_elsewhere(cache, caplog)


def _mounted(folder, options):
    """Mounts a small file system on a folder, where that is allowed."""
    if subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", folder], capture_output=True).returncode:
        pytest.skip("only root can mount a file system")


@pytest.mark.parametrize("size", ["8k", "88k"])
def test_a_full_disk_is_noticed_before_llvm_writes(cache, caplog, size):
    """LLVM would end the process: there is no room for the source, or for the source but not for the object."""
    _mounted(cache, f"size={size}")
    try:
        run()
        assert _is_elsewhere(cache, caplog)
    finally:
        subprocess.run(["umount", cache], check=True)


def test_a_cache_that_is_only_read_serves_what_it_has(cache, caplog):
    """Nothing is compiled or said where the cache has the kernel; damaged there, it is compiled elsewhere."""
    run()
    subprocess.run(["mount", "--bind", "-o", "ro", cache, cache], capture_output=True)
    subprocess.run(["mount", "-o", "remount,ro,bind", cache], capture_output=True)
    try:
        if os.access(cache, os.W_OK):
            pytest.skip("only root can make a folder read-only for itself")
        run()
        assert not caplog.records and Path(wp.config.kernel_cache_dir) == cache
    finally:
        subprocess.run(["umount", cache], capture_output=True)
    flip(*files(cache, ".o"))
    subprocess.run(["mount", "--bind", cache, cache], check=True)
    subprocess.run(["mount", "-o", "remount,ro,bind", cache], check=True)
    try:
        run()
        assert _is_elsewhere(cache, caplog)
        assert len(files(Path(wp.config.kernel_cache_dir), ".cpp")) == 1
    finally:
        subprocess.run(["umount", cache], check=True)


def test_no_room_anywhere_is_one_line(cache):
    """Where no file can grow, the error names the cache and what to do."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        with pytest.raises(ir.InputError, match=r"kernel cache .* cannot be written: .*WARP_CACHE_PATH"):
            run()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


PROCESS = """
import warp as wp
wp.config.log_level = wp.LOG_WARNING
from warp_ir.device.launcher import Launcher
from warp_ir.film import accumulate
launcher = Launcher("cpu")
launcher.load([accumulate])
print(wp.get_module(accumulate.__name__).execs != {})
"""


def test_a_cache_that_cannot_be_made():
    """A new process whose cache can have no folder compiles in a temporary one, which is gone afterwards."""
    env = {**os.environ, "WARP_CACHE_PATH": "/dev/null/cache"}
    done = subprocess.run([sys.executable, "-c", PROCESS], env=env, capture_output=True, text=True)
    assert done.stdout == "True\n", done.stderr
    assert "cannot be written" in done.stderr


@pytest.mark.slow
def test_two_cold_processes_side_by_side(tmp_path):
    """Both compile into the same empty cache, and both finish."""
    env = {**os.environ, "WARP_CACHE_PATH": str(tmp_path)}
    command = [sys.executable, "-c", PROCESS]
    both = [subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate()[0] for process in both] == ["True\n", "True\n"]
