"""Every kernel compiles for CUDA, on a machine that has none; and computes the same where there is one."""

import ast
import ctypes
import importlib.util
import struct
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
import warp_ir.estimators.vpl
import warp_ir.vpl.emission
from tests.physics.scenes import box_with_lights
from warp_ir.device import definitions
from warp_ir.device.launcher import MAX_REGISTERS
from warp_ir.device_scene import SceneData
from warp_ir.procedural import cornell_box, furnace
from warp_ir.renderer import Renderer
from warp_ir.settings import GuidingSettings

pytestmark = pytest.mark.extended

wp.set_module_options({"enable_backward": False})

_REGISTERS, _FRAME = 0x2F, 0x11  # EIATTR_REGCOUNT, EIATTR_FRAME_SIZE
_MOST_REGISTERS = 128  # let a multiprocessor hold 512 threads
_MOST_LOCAL = 128  # an array of a few boxes, which a loop indexes
# `path` has 2232: six copies of the tables of distributions, which functions take by value (168 bytes; three
# in the kernel, three in `_sample_light`), 256 in smaller arrays, and the registers that four calls, one in the other,
# keep. One of these calls is that of the light paths of spots: without it `path` has 1816.
# Light paths have the most, 2312.
_MOST_LOCAL_OF_RAYS = 2320
# Light paths of many worlds have copies of their world's settings and buffers in addition.
_MOST_LOCAL_OF_WORLDS = 3328
PACKAGE = Path(ir.__file__).parent
EXTRAS = {"newton": "newton", "mujoco": "mujoco_warp"}
"""What the kernels of a folder need."""
KERNEL_FILES = [
    importlib.import_module(".".join(("warp_ir", *path.relative_to(PACKAGE).with_suffix("").parts)))
    for path in sorted(PACKAGE.rglob("*.py"))
    if "@wp.kernel" in path.read_text()
    and (path.parent.name not in EXTRAS or importlib.util.find_spec(EXTRAS[path.parent.name]) is not None)
]


def compiled_with(module):
    """For every kernel in a file, the module that it is compiled with: its own, unless the decorator names another."""
    for node in ast.walk(ast.parse(Path(module.__file__).read_text())):
        for decorator in getattr(node, "decorator_list", ()):
            if "wp.kernel" in ast.unparse(decorator):
                named = {k.arg: k.value for k in getattr(decorator, "keywords", ())}
                yield named["module"].value if "module" in named else module.__name__


KERNELS = Counter(name for file in KERNEL_FILES for name in compiled_with(file))
"""How many there are in a module."""


@wp.kernel
def _index_locally(first: int, numbers: wp.array[wp.float32], places: wp.array[wp.int32]):
    i = first + wp.tid()
    local = wp.zeros(shape=64, dtype=wp.float32)
    for k in range(64):
        local[places[i + k]] = numbers[k]
    numbers[i] = local[places[i]]


@wp.kernel
def _add_one(first: int, numbers: wp.array[wp.float32]):
    numbers[first + wp.tid()] += 1.0


@pytest.mark.parametrize("module", sorted(KERNELS))
@pytest.mark.parametrize("arch", [pytest.param(75, marks=pytest.mark.slow), 90])
def test_kernels_compile_for_cuda(module, arch, tmp_path):
    """Turing and Hopper machine code comes out of every module, and no thread asks for more than it should."""
    definitions.define_all()
    wp.compile_aot_module(wp.get_module(module), arch=arch, module_dir=tmp_path, use_ptx=False)
    (cubin,) = tmp_path.glob("*.cubin")
    used = resources(cubin)
    assert len(used) == KERNELS[module]
    traces_rays = "intersect_scene_" in next(tmp_path.glob("*.cu")).read_text()
    for name, (registers, local) in used.items():
        if traces_rays and local > _MOST_LOCAL:
            assert registers <= MAX_REGISTERS, f"{name}: {registers} registers"
            # A copy of the scene's record, or the stack of the CPU's traversal, does not fit.
            most = _MOST_LOCAL_OF_WORLDS if name.startswith("_trace_world_paths") else _MOST_LOCAL_OF_RAYS
            assert _MOST_LOCAL_OF_RAYS < ctypes.sizeof(SceneData.ctype)
            assert local <= most, f"{name}: {local} bytes"
        else:
            assert registers <= _MOST_REGISTERS, f"{name}: {registers} registers"
            assert local <= _MOST_LOCAL, f"{name}: {local} bytes of local memory"


def test_resources_are_read(tmp_path):
    """A kernel that indexes an array of 64 floats at run time has its 256 bytes in local memory; another has none."""
    wp.compile_aot_module(wp.get_module(__name__), arch=90, module_dir=tmp_path, use_ptx=False)
    used = resources(next(tmp_path.glob("*.cubin")))
    (array,) = (v for k, v in used.items() if k.startswith("_index_locally"))
    (plain,) = (v for k, v in used.items() if k.startswith("_add_one"))
    assert array[1] >= 256 and plain[1] == 0
    assert 4 <= plain[0] <= array[0] <= 64


def resources(cubin):
    """Registers and bytes of local memory (stack and spills) per thread of every kernel of a .cubin file.

    They are attributes in its section .nv.info, of the form (format 4, attribute, 16-bit size, symbol, value).
    """
    data = cubin.read_bytes()
    (table,) = struct.unpack_from("<Q", data, 0x28)
    size, count, names = struct.unpack_from("<HHH", data, 0x3A)
    headers = [struct.unpack_from("<IIQQQQIIQQ", data, table + size * k) for k in range(count)]

    def text(offset, strings):
        begin = strings[4] + offset
        return data[begin : data.index(b"\0", begin)].decode()

    sections = {text(header[0], headers[names]): header for header in headers}
    place, end = sections[".nv.info"][4], sum(sections[".nv.info"][4:6])
    found = {}
    while place < end:
        form, attribute, length = struct.unpack_from("<BBH", data, place)
        place += 4
        if form != 4:
            continue  # its value is the length
        if attribute in (_REGISTERS, _FRAME):
            symbol, value = struct.unpack_from("<II", data, place)
            (name,) = struct.unpack_from("<I", data, sections[".symtab"][4] + 24 * symbol)
            found.setdefault(text(name, sections[".strtab"]), {})[attribute] = value
        place += length
    return {k: (v[_REGISTERS], v.get(_FRAME, 0)) for k, v in found.items() if _REGISTERS in v and "$" not in k}


def test_drawn_vpls_have_room():
    """A thread without lanes keeps the VPLs that it has drawn in an array of eight."""
    how = warp_ir.estimators.vpl
    assert max(*how.SHADOW_RAYS, *how.COMPENSATION_SHADOW_RAYS) <= warp_ir.vpl.gather.MAX_RAYS


READS = ("numpy", "list", "to", "cptr", "__array_interface__", "__dlpack__", "__str__")
WAITS = ("synchronize", "synchronize_stream", "synchronize_event", "get_event_elapsed_time")


@pytest.mark.parametrize(
    "scene, settings, capacity",
    [
        (cornell_box(), {}, None),
        (cornell_box(), {"max_bounces": 0}, None),
        (cornell_box(), {"light_paths": 4096}, 1000),  # of 10 000 VPLs on surfaces
        (cornell_box(), {"light_paths": 16}, 1),
        (cornell_box(), {"estimator": "keller"}, None),
        (cornell_box(), {"estimator": "path"}, None),
        (furnace(0.5, 0.0, level=1), {}, None),
    ],
)
def test_iterations_read_nothing_back(scene, settings, capacity, monkeypatch):
    """An iteration does without whatever the host would have to wait for, and comes to the same bits without it.

    A launcher that takes the CPU for a device to wait for runs kernels over all rows that there may be.
    """
    settings = ir.RenderSettings(**{"width": 24, "height": 24, "light_paths": 64, "iterations": 3, **settings})
    if capacity is not None:
        monkeypatch.setattr(warp_ir.vpl.emission, "_MAX_CAPACITY", capacity)
    expected = ir.render(scene, settings)
    renderer = Renderer(scene, settings)
    renderer.launcher.synchronous = False
    film = renderer.new_film()
    renderer.add_iteration(film, 0)  # learns the guide, which may read
    with blind(monkeypatch) as waits:
        for iteration in range(1, 3):
            renderer.add_iteration(film, iteration)
            assert len(waits) == iteration  # when it is done
    renderer.report_profile(film)
    np.testing.assert_array_equal(film.radiance(), expected.radiance())
    assert film.counts == expected.counts
    if capacity is not None:
        assert film.counts["vpls"] == 3 * (settings.light_paths + capacity)


@pytest.mark.parametrize("name", ["rooms", "house"])
def test_guided_iterations_read_nothing_back(name, monkeypatch):
    """Guided iterations read nothing back either; learning the guide, which happens one time, may read."""
    monkeypatch.syspath_prepend(str(PACKAGE.parent / "benchmarks"))
    import wide_scenes

    guiding = GuidingSettings(first_iteration=1)
    settings = ir.RenderSettings(width=24, height=24, light_paths=64, iterations=4)
    scene = getattr(wide_scenes, name)()
    expected = Renderer(scene, settings, guiding=guiding).render()
    assert expected.counts["guided_paths"] == 1
    renderer = Renderer(scene, settings, guiding=guiding)
    renderer.launcher.synchronous = False
    film = renderer.new_film()
    for iteration in range(2):
        renderer.add_iteration(film, iteration)
    with blind(monkeypatch):
        for iteration in range(2, 4):
            renderer.add_iteration(film, iteration)
    np.testing.assert_array_equal(film.radiance(), expected.radiance())


def test_reading_is_noticed(monkeypatch):
    """Where nothing may be read, every way to read fails, and so does an iteration that counts its VPLs."""
    renderer = Renderer(cornell_box(), ir.RenderSettings(width=8, height=8, light_paths=8))
    array, film = renderer.launcher.zeros(1, wp.int32), renderer.new_film()
    with blind(monkeypatch):
        for read in (array.numpy, array.list, lambda: array.to("cpu"), lambda: np.asarray(array), lambda: str(array)):
            with pytest.raises(AssertionError, match="read back"):
                read()
        with pytest.raises(AssertionError, match="read back"):
            wp.synchronize()
        with pytest.raises(AssertionError, match="read back"):
            renderer.add_iteration(film, 0)
    assert array.numpy().tolist() == [0]


@contextmanager
def blind(monkeypatch):
    """Lets nothing be read from an array while it lasts, nor be waited for but a whole device: when, it tells."""
    waits = []

    def fail(*_, **__):
        raise AssertionError("read back")

    with monkeypatch.context() as context:
        for name in READS:
            is_property = isinstance(getattr(wp.array, name), property)
            context.setattr(wp.array, name, property(fail) if is_property else fail)
        for name in WAITS:
            context.setattr(wp, name, fail)
        context.setattr(wp, "synchronize_device", waits.append)
        yield waits


def test_only_the_launcher_knows_the_device():
    """Whether a kernel's work can be looked at is asked in few places: so the CPU can stand for CUDA in these tests."""
    asking = {path.name for path in PACKAGE.rglob("*.py") if "is_cuda" in path.read_text()}
    assert asking == {"launcher.py", "launch_list.py", "profiling.py", "build.py", "forest.py", "live_scene.py"}


@pytest.mark.gpu
@pytest.mark.parametrize("estimator", ["vpl", "keller", "path"])
def test_cuda_agrees_with_cpu(estimator):
    """The same picture up to rounding: the samples are the same numbers; a ray at an edge may fall the other way."""
    settings = ir.RenderSettings(width=64, height=64, iterations=2, light_paths=128, estimator=estimator)
    cpu = ir.render(box_with_lights(), settings).radiance()
    gpu = ir.render(box_with_lights(), settings, device="cuda:0").radiance()
    different = np.abs(cpu - gpu).max(axis=2) > 2e-3 * cpu.mean()
    assert different.mean() <= 0.05
    assert gpu.mean() == pytest.approx(cpu.mean(), rel=2e-3)
