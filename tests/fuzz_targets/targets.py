"""Parsers of untrusted data as functions of bytes: each returns, or raises what it promises, and nothing else.

    python -m tests.fuzz_targets.targets NAME [-max_total_time=60] [FOLDER ...]    # needs atheris; libFuzzer's options

The inputs of `corpus` are where fuzzing begins, and what a test runs without atheris.
"""

import io
import os
import sys
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

_MAX_BYTES = 1 << 16


@cache
def _folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="warp_ir_fuzz_"))


def _file(data: bytes, suffix: str) -> str:
    path = _folder() / f"input{suffix}"
    path.write_bytes(data[:_MAX_BYTES])
    return str(path)


def ies(data: bytes) -> None:
    """A photometric profile: its factors are finite and not negative."""
    from pxr import Sdf

    from warp_ir.usd.lights.ies import read_profile
    from warp_ir.usd.values.report import Unreadable

    path = _file(data, ".ies")
    try:
        table = read_profile(Sdf.AssetPath(path, path), 0.0, bool(len(data) % 2))
    except Unreadable:
        return
    assert np.isfinite(table).all() and table.min() >= 0.0


def film(data: bytes) -> None:
    """A film, which checkpoints are, too."""
    from warp_ir import Film, InputError

    try:
        loaded = Film.load(_file(data, ".npz"))
    except InputError as error:
        assert "\n" not in str(error)
        return
    picture = loaded.radiance()
    assert np.isfinite(picture).all() and loaded.iterations >= 0


def frames(data: bytes) -> None:
    """A frame specification: a list of at most a million numbers."""
    from warp_ir.cli.frames import time_codes
    from warp_ir.scene import InputError

    try:
        codes = time_codes(data[:200].decode("utf-8", "replace"))
    except InputError:
        return
    assert 0 < len(codes) <= 1_000_000


def toml(data: bytes) -> None:
    """A file of presets, and settings made of it."""
    from warp_ir.cli.toml_file import read_toml
    from warp_ir.scene import InputError
    from warp_ir.settings import RenderSettings

    try:
        values = read_toml(_file(data, ".toml"))
    except InputError:
        return
    fields = RenderSettings.__dataclass_fields__
    try:
        RenderSettings(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k in fields})
    except InputError as error:
        assert error.args


def crate(data: bytes) -> None:
    """The tables of a .usdc, which USD itself would believe."""
    from warp_ir.scene import InputError
    from warp_ir.usd.stage.crate_validation import validate_crate

    try:
        validate_crate(_file(data, ".usdc"))
    except InputError as error:
        assert "\n" not in str(error)


def usda(data: bytes) -> None:
    """The depth of a text layer, and the layers that it refers to."""
    from warp_ir.scene import InputError
    from warp_ir.usd.stage.layers_check import check_layers

    try:
        check_layers(_file(data, ".usda"))
    except InputError:
        return


def mtlx(data: bytes) -> None:
    """A MaterialX document as a layer."""
    from pxr import Tf

    from warp_ir.usd.stage.materialx import materialx_layer
    from warp_ir.usd.values.report import Unreadable

    try:
        materialx_layer(_file(data, ".mtlx"))
    except (Unreadable, Tf.ErrorException):
        return


def mdl(data: bytes) -> None:
    """The call in an .mdl file."""
    from pxr import Sdf

    from warp_ir.usd.shading.mdl import read_mdl_call

    path = _file(data, ".mdl")
    call = read_mdl_call(Sdf.AssetPath(path, path), "Wood")
    assert call is None or all(np.isfinite(values).all() for values in call.numbers.values())


TARGETS: dict[str, Callable[[bytes], None]] = {
    "ies": ies,
    "film": film,
    "frames": frames,
    "toml": toml,
    "crate": crate,
    "usda": usda,
    "mtlx": mtlx,
    "mdl": mdl,
}


def corpus(name: str) -> list[bytes]:
    """Sound inputs, and inputs that were damaged where it once mattered."""
    inputs = [*_sound(name), b"", b"\0" * 64]
    stored = Path(__file__).parent / "corpus" / name
    return inputs + [path.read_bytes() for path in sorted(stored.glob("*"))]


def _sound(name: str) -> list[bytes]:
    rows = "0 45 90\n0 180\n100 50 0\n100 60 0\n"
    match name:
        case "ies":
            return [
                f"IESNA:LM-63-2002\nTILT=NONE\n1 1000 1 3 2 {kind} 2 0 0 0\n1 1 100\n{rows}".encode() for kind in (1, 2)
            ]
        case "film":
            return [_film()]
        case "frames":
            return [b"101:109x2,7", b"1:2x0.5", b"-3:+3", b"1e3"]
        case "toml":
            return [b'width = 64\nestimator = "vpl"\ndata_window = [0.0, 0.0, 0.5, 1.0]\nfilter = false\n']
        case "crate":
            return [_crate()]
        case "usda":
            return [b'#usda 1.0\n( subLayers = [@a.usda@] )\ndef Xform "A" {\n  """ { """\n  def Cube "B" { }\n}\n']
        case "mtlx":
            surface = '<standard_surface name="S" type="surfaceshader"><input name="base" type="float" value="1"/>'
            material = '<surfacematerial name="M" type="material"><input name="surfaceshader" type="surfaceshader"'
            text = f'{surface}</standard_surface>{material} nodename="S"/></surfacematerial>'
            return [f'<?xml version="1.0"?><materialx version="1.39">{text}</materialx>'.encode()]
        case "mdl":
            call = 'OmniPBR(diffuse_color_constant: color(0.1, 0.2f, .3), diffuse_texture: texture_2d("a.png"))'
            return [f"mdl 1.4; import OmniPBR::*; // a\nexport material Wood(*) = {call};".encode()]
    raise KeyError(name)


@cache
def _film() -> bytes:
    import warp_ir as ir
    from warp_ir.procedural import furnace

    settings = ir.RenderSettings(width=2, height=2, iterations=1, estimator="path", max_bounces=0)
    path = _folder() / "sound.npz"
    ir.render(furnace(level=0), settings).save(path)
    packed = io.BytesIO()  # stored without compression, so that the fuzzer sees the bytes
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    return packed.getvalue()


@cache
def _crate() -> bytes:
    from pxr import Usd, UsdGeom

    path = _folder() / "sound.usdc"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.Cube.Define(stage, "/A/B").CreateSizeAttr(3.0)
    stage.GetRootLayer().Save()
    return path.read_bytes()


def main() -> None:
    """Fuzzes one target, until libFuzzer's limit or the first input that fails."""
    import atheris

    name, *options = sys.argv[1:]
    target = TARGETS[name]
    with atheris.instrument_imports(include=["warp_ir"]):
        for sound in corpus(name):
            target(sound)  # imports what it needs
    seeds = _folder() / "seeds"
    seeds.mkdir()
    for k, data in enumerate(corpus(name)):
        (seeds / str(k)).write_bytes(data)
    os.environ.setdefault("WARP_CACHE_PATH", str(_folder()))
    atheris.Setup([sys.argv[0], *options, str(seeds)], target)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
