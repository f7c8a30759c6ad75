"""A film file that is not as `Film.save` writes it is refused in one line, before it can take memory."""

import io
import os
import resource
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

import warp_ir as ir
from tests.physics.scenes import cornell_box
from warp_ir.cli import main

pytestmark = pytest.mark.extended

SETTINGS = ir.RenderSettings(width=12, height=10, light_paths=16, iterations=4, visible_lights=True)


@pytest.fixture(scope="module")
def renderer():
    return ir.Renderer(cornell_box(), SETTINGS)


@pytest.fixture(scope="module")
def whole(renderer, tmp_path_factory):
    """The arrays of a film by name, and the file."""
    film = renderer.new_film()
    for iteration in range(4):
        renderer.add_iteration(film, iteration)
        film.measure_noise()
    film.seconds = 2.0
    path = tmp_path_factory.mktemp("film") / "whole.npz"
    film.save(path, key="room")
    with np.load(path) as file:
        return dict(file), path.read_bytes()


def npy(array, **header):
    """The bytes of a .npy file, whose header may claim something else."""
    out = io.BytesIO()
    if not header:
        np.save(out, array)
        return out.getvalue()
    described = np.lib.format.header_data_from_array_1_0(array) | header
    np.lib.format.write_array_header_1_0(out, described)
    return out.getvalue() + array.tobytes()


def archive(path, members, compression=zipfile.ZIP_STORED):
    """Writes a .npz file: name -> array, or the bytes of the member."""
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, value in members.items():
            file.writestr(f"{name}.npy", value if isinstance(value, bytes) else npy(value))
    return path


def changed(array, where, value):
    out = np.array(array)
    out[where] = value
    return out


def _forgeries():
    """Name -> what it makes of the arrays of a film."""

    def put(name, make):
        return lambda arrays: {**arrays, name: make(arrays[name])}

    out = {
        f"{name} missing": lambda a, n=name: {k: v for k, v in a.items() if k != n} for name in ("key", "size", "mesh")
    }
    for name in ("direct", "standard_deviation", "position", "reconstruction_direct", "noise_picture", "origin"):
        out[f"{name} NaN"] = put(name, lambda x: changed(x, 0, np.nan))
        out[f"{name} infinite"] = put(name, lambda x: changed(x, -1, np.inf))
    for name in ("direct", "emission", "albedo", "reconstruction_squares", "count", "hits", "lights", "rejected"):
        out[f"{name} negative"] = put(name, lambda x: changed(x, 3, -1))
    for name in ("seconds", "scale", "size"):
        out[f"{name} negative"] = put(name, lambda x: -x)
    for value in (np.nan, np.inf, 0.0):
        out[f"scale {value}"] = put("scale", lambda x, v=value: np.float64(v))
        out[f"seconds {value}"] = put("seconds", lambda x, v=value: np.float64(v or np.nan))
    for name in (
        "direct",
        "count",
        "chosen",
        "size",
        "mesh",
        "noise_variance",
        "noise_picture",
        "reconstruction_count",
    ):
        out[f"{name} short"] = put(name, lambda x: x[:-1])
        out[f"{name} long"] = put(name, lambda x: np.concatenate([x, x]))
        out[f"{name} flat"] = put(name, lambda x: x[None])
        out[f"{name} of another type"] = put(name, lambda x: x.astype(np.float16))
    for name in ("direct", "count", "size", "noise_picture"):
        out[f"{name} in the other order of bytes"] = put(name, lambda x: x.astype(x.dtype.newbyteorder(">")))
    out |= {
        "count of one pixel": put("count", lambda x: changed(x, 5, 3)),
        "counts beyond the iterations": put("count", lambda x: x + 1),
        "a billion iterations": put("size", lambda x: np.array([12, 10, 2**31], np.int64)),
        "fewer iterations": put("size", lambda x: np.array([12, 10, 3], np.int64)),
        "other sides": put("size", lambda x: np.array([10, 12, 4], np.int64)),
        "huge": put("size", lambda x: np.array([2**20, 2**20, 4], np.int64)),
        "overflow": put("size", lambda x: np.array([2**32 + 12, 2**32 + 10, 4], np.int64)),
        "no pixels": put("size", lambda x: np.array([0, 10, 4], np.int64)),
        "more hits than iterations": put("hits", lambda x: changed(x, 7, 5)),
        "more rejected": put("rejected", lambda x: changed(x, 7, 5)),
        "more samples of the filter": put("reconstruction_count", lambda x: x + 100),
        "a mesh that is not there": put("mesh", lambda x: changed(x, 7, 10_000)),
        "no mesh below -1": put("mesh", lambda x: changed(x, 7, -2)),
        "no tile": put("chosen", lambda x: ~(x | True)),
        "noise of no iterations": put("noise_iterations", lambda x: 0 * x),
        "noise of more iterations": put("noise_iterations", lambda x: 9 + x),
        "negative noise": put("noise_variance", lambda x: 0 * x - 1.0),
        "another key": put("key", lambda x: np.array("hall")),
        "key of bytes": put("key", lambda x: np.array(b"room")),
        "key of many": put("key", lambda x: np.array(["room", "room"])),
        "key of no characters": put("key", lambda x: npy(np.array([0x7FFFFFFF] * 4, "<u4"), descr="<U4", shape=())),
        "key of a megabyte": put("key", lambda x: np.array("a" * 400_000)),
        "a pickle": put("mesh", lambda x: np.array([{}] * len(x), object).dumps()),
        "an array of objects": put("mesh", lambda x: npy(x, descr="|O", shape=(len(x) // 2,))),
        "an array by columns": put("direct", lambda x: npy(x, fortran_order=True)),
        "more rows than bytes": put("direct", lambda x: npy(x, shape=(2**40, 3))),
        "negative rows": put("direct", lambda x: npy(x, shape=(-1, 3))),
        "a nested type": put("direct", lambda x: npy(x, descr=[("a", "<f4", (3,))], shape=(len(x),))),
        "no header": put("direct", lambda x: b"\x93NUMPY"),
        "nothing": put("direct", lambda x: b""),
        "another version": put("direct", lambda x: b"\x93NUMPY\x03\x00" + npy(x)[8:]),
        "a header that is no Python": put("direct", lambda x: npy(x).replace(b"'descr'", b"'descr\x00", 1)),
        "a header of brackets": put("direct", lambda x: b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535),
    }
    return out


FORGERIES = _forgeries()


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_film_is_refused(renderer, whole, tmp_path, name):
    """Missing, misshapen and impossible arrays: one line that names the file, and the film stays as it was."""
    path = archive(tmp_path / "forged.npz", FORGERIES[name](whole[0]))
    film = renderer.new_film()
    with pytest.raises(ir.InputError, match=r"forged\.npz: ") as caught:
        film.resume(path, "room")
    assert "\n" not in str(caught.value) and film.iterations == 0 and film.radiance().max() == 0.0
    # What is read without a filter, a scene and its size; of wrong sides even the tiles may fit.
    needed = (
        "noise",
        "negative noise",
        "reconstruction",
        "more samples",
        "another key",
        "key of no",
        "a mesh",
        "other sides",
    )
    if not name.startswith(needed):
        with pytest.raises(ir.InputError, match=r"forged\.npz: "):
            ir.Film.load(path)


def test_what_is_not_forged_is_read(renderer, whole, tmp_path):
    """A film file with other members, written by the same means."""
    film = renderer.new_film()
    film.resume(archive(tmp_path / "film.npz", whole[0]), "room")
    assert film.iterations == 4 and ir.Film.load(tmp_path / "film.npz").iterations == 4


def _files(path, arrays, data):
    """Name -> how to write what is no film."""

    def replaced(old, new):
        assert old in data
        return lambda: path.write_bytes(data.replace(old, new))

    entry = b"PK\x01\x02" + data.partition(b"PK\x01\x02")[2][:4]
    direct = arrays["direct"].tobytes()
    return {
        "compressed": lambda: archive(path, arrays, zipfile.ZIP_DEFLATED),
        "a bomb": lambda: archive(path, {**arrays, "direct": bytes(1 << 28)}, zipfile.ZIP_DEFLATED),
        "half": lambda: path.write_bytes(data[: len(data) // 2]),
        "cut": lambda: path.write_bytes(data[:-1]),
        "empty": lambda: path.write_bytes(b""),
        "text": lambda: path.write_text("no film"),
        "an array": lambda: path.write_bytes(npy(np.zeros(3))),
        "other data": replaced(direct, bytes(len(direct))),
        "an array twice": replaced(b"indirect.npy", b"emission.npy"),
        "encrypted": replaced(entry + b"\0\0", entry + b"\1\0"),
        "a pipe": lambda: os.mkfifo(path),
        "a folder": lambda: path.mkdir(),
        "nowhere": lambda: None,
        "a loop": lambda: path.symlink_to(path),
    }


FILES = "compressed", "a bomb", "half", "cut", "empty", "text", "an array", "other data", "an array twice", "encrypted"


@pytest.mark.parametrize("name", [*FILES, "a pipe", "a folder", "nowhere", "a loop"])
def test_what_is_no_film_is_refused(renderer, whole, tmp_path, name):
    """Archives that are damaged or compressed, and what is no file at all: at once, and with little memory."""
    path = tmp_path / "film.npz"
    _files(path, *whole)[name]()
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    for read in (lambda: renderer.new_film().resume(path, "room"), lambda: ir.Film.load(path)):
        with pytest.raises(ir.InputError, match=r"film\.npz: "):
            read()
    assert time.monotonic() - start < 5.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB


def test_the_command_refuses_it_too(tmp_path, capsys):
    """`--resume` of a forged checkpoint ends in one line that says what to do, with exit code 2."""
    (tmp_path / "a.npy.film.npz").write_bytes(b"PK")
    room = Path(__file__).parent.parent / "scenes_usd" / "cornell_box.usda"
    assert main(["render", str(room), str(tmp_path / "a.npy"), "--width", "8", "--light-paths", "16", "--resume"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "not a film" in said and "remove it, or render without --resume" in said
