"""Mutated files load or are refused in one line: no traceback, no crash, no hang, no memory without bound."""

import re
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from pxr import Tf, UsdUtils

import warp_ir as ir
from tests import fuzz
from warp_ir.usd.stage.crate_validation import validate_crate

ROOT = Path(__file__).resolve().parents[1]
BATCH = 200
SECONDS = 20.0
"""For one file; they are small, and take some 30 ms."""
MEBIBYTES = 1500
"""For the process, which has USD and NumPy in it."""


@pytest.fixture(scope="session")
def sources(tmp_path_factory):
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    found = fuzz.seeds(tmp_path_factory.mktemp("sources"))
    delegate.TakeUncoalescedDiagnostics()
    return found


def _outcomes(folder, sources, seeds):
    """What became of the file of each seed, in a process that none of them may end."""
    files = []
    for seed in seeds:
        try:
            files.append(fuzz.mutate(sources, folder, seed).name)
        except Tf.ErrorException:  # not even USD writes that
            continue
    orders = "".join(f"{name} {'medium' if k % 3 else 'low'}\n" for k, name in enumerate(files))
    command = [sys.executable, "-W", "error", "-X", "faulthandler", "-m", "tests.fuzz", str(folder)]
    try:
        done = subprocess.run(
            command, input=orders, capture_output=True, text=True, cwd=ROOT, timeout=SECONDS * 10, check=False
        )
        said, error = done.stdout.splitlines(), done.stderr
    except subprocess.TimeoutExpired as late:
        said, error = (late.stdout or b"").decode().splitlines(), "too late"
    assert len(said) == len(files), f"{files[len(said)]}: the process ended there: {error[-2000:]}"
    return [re.fullmatch(r"(\S+) (\S+) (\S+) (.*)", line).groups() for line in said]


@pytest.mark.extended
def test_the_unharmed_sources_load(tmp_path, sources):
    """What is mutated is sound: every source is a scene with triangles, without skipped prims."""
    for source in sources:
        scene = ir.load_usd(source)
        assert scene.triangle_count > 0 and not any("skipped" in line for line in scene.warnings), scene.warnings


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(12))
def test_mutated_files_load_or_are_refused(tmp_path, sources, batch):
    """Bytes flipped, moved and cut; text rewritten; values of wrong types, lengths and indices; cycles."""
    outcomes = _outcomes(tmp_path, sources, range(batch * BATCH, (batch + 1) * BATCH))
    for name, seconds, memory, outcome in outcomes:
        assert outcome.startswith(("scene", "refused")), f"{name}: {outcome}"
        assert float(seconds) < SECONDS and int(memory) < MEBIBYTES, f"{name}: {seconds} s, {memory} MiB"
    loaded = sum(outcome.startswith("scene") for *_, outcome in outcomes)
    assert BATCH // 4 < loaded < BATCH  # mutations that never, or always, stop the loader test little


def _with_checksum(package: bytearray, start: int) -> bytearray:
    """A package [bytes] whose first file, which begins at byte `start`, has the right checksum again."""
    size = int.from_bytes(package[18:22], "little")
    package[14:18] = zlib.crc32(package[start : start + size]).to_bytes(4, "little")
    return package


def test_a_damaged_count_costs_no_memory(tmp_path, sources):
    """A .usdc whose table of contents claims 2³² entries is refused at once, alone and inside of a .usdz."""
    for suffix in (".usdc", ".usdz"):
        source = next(path for path in sources if path.name == f"cornell_box{suffix}")
        data = bytearray(source.read_bytes())
        start = data.index(b"PXR-USDC")
        directory = start + int.from_bytes(data[start + 16 : start + 24], "little")
        tokens = data.index(b"TOKENS\0", directory)
        table = start + int.from_bytes(data[tokens + 16 : tokens + 24], "little")
        for offset, count, name in ((directory, 1 << 27, "of contents"), (table, 1 << 40, "TOKENS")):
            damaged = bytearray(data)
            damaged[offset : offset + 8] = count.to_bytes(8, "little")
            if suffix == ".usdz":
                _with_checksum(damaged, start)
            (tmp_path / f"bad{suffix}").write_bytes(damaged)
            with pytest.raises(ir.InputError, match=f"table {name} is damaged"):
                ir.load_usd(tmp_path / f"bad{suffix}")


def test_paths_that_are_no_tree_are_refused(tmp_path, sources):
    """USD's reader ends the process, or never ends, where two jumps of a .usdc's paths reach the same node."""
    data = next(path for path in sources if path.name == "cornell_box.usdc").read_bytes()
    entry = data.index(b"PATHS\0", int.from_bytes(data[16:24], "little"))
    start = int.from_bytes(data[entry + 16 : entry + 24], "little")
    count = int.from_bytes(data[start + 8 : start + 16], "little")
    before_jumps = 16
    for _ in range(2):
        before_jumps += 8 + int.from_bytes(data[start + before_jumps :][:8], "little")

    def with_jumps(jumps: np.ndarray) -> bytes:
        """The file with other jumps [count], in a table of paths at its end; differences of 32 bits each."""
        codes = bytes([0xFF]) * (2 * count // 8) + (bytes([(1 << 2 * (count % 4)) - 1]) if count % 4 else b"")
        plain = bytes(4) + codes + np.diff(jumps, prepend=0).astype("<i4").tobytes()
        more = len(plain) - 15  # one LZ4 sequence of literals alone; its length is 15 and bytes that are added to it
        packed = bytes([0, 0xF0]) + bytes([255] * (more // 255) + [more % 255]) + plain
        table = data[start : start + before_jumps] + len(packed).to_bytes(8, "little") + packed
        moved = len(data).to_bytes(8, "little") + len(table).to_bytes(8, "little")
        return data[: entry + 16] + moved + data[entry + 32 :] + table

    # Every node but the last has a child and a sibling: 2^count ways lead to the last.
    tangle = np.r_[np.full(count - 2, 2), -1, -2]
    # The nodes one below the other are a tree: the table is refused for its tangle, not for its place.
    chain = np.r_[np.full(count - 1, -1), -2]
    (tmp_path / "chain.usdc").write_bytes(with_jumps(chain))
    validate_crate(str(tmp_path / "chain.usdc"))
    (tmp_path / "tangle.usdc").write_bytes(with_jumps(tangle))
    with pytest.raises(ir.InputError, match="table PATHS is damaged"):
        ir.load_usd(tmp_path / "tangle.usdc")


def test_text_that_is_no_text_is_refused(tmp_path):
    """An error message that quotes bytes which are no UTF-8 is still one line."""
    (tmp_path / "bad.usda").write_bytes(b'#usda 1.0\ndef Mesh "\xfb\xe8" {\n')
    with pytest.raises(ir.InputError, match="damaged") as caught:
        ir.load_usd(tmp_path / "bad.usda")
    assert "\n" not in str(caught.value)
