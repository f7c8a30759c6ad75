"""Cryptomatte: numbers of names, layers of ranks, and the coverage that camera rays count."""

import json
import struct

import numpy as np
import OpenImageIO as oiio
import pytest

import warp_ir as ir
from warp_ir.image import ExrOptions, read_image, write_image
from warp_ir.image.cryptomatte import RANKS, Cryptomatte, float_bits, float_id, murmur3


def test_numbers_are_the_specifications():
    """The names that the specification has as examples have its numbers."""
    known = {"bunny": 0x13851A76, "default": 0x42C9679F, "bunny_porcelain_mat": 0xB24B26D4}
    assert {name: float_bits(name) for name in known} == known
    assert struct.pack(">f", float_id("bunny")).hex() == "13851a76"


def test_hash_is_murmurs():
    """Values that are known of MurmurHash3_x86_32 with the seed 0, for every length of the rest."""
    known = {b"": 0, b"a": 0x3C2569B2, b"ab": 0x9BBFD75F, b"abc": 0xB3DD93FA, b"abcd": 0x43ED676A}
    assert {data: murmur3(data) for data in known} == known


def test_numbers_are_finite_and_normal():
    """Whatever the name, the exponent is from 1 to 254: no infinity, NaN or denormal, and the sign is kept."""
    bits = [float_bits(f"/World/Prim{i}") for i in range(5000)]
    assert all(1 <= b >> 23 & 0xFF <= 254 for b in bits) and {b >> 31 for b in bits} == {0, 1}
    assert {float_bits(name) >> 23 & 0xFF for name in ("/World/Prim3", "")} <= set(range(1, 255))
    assert float_bits("") == 1 << 23  # the hash 0


def matte(kind="object"):
    """Two pixels: half /A, a quarter /B; nothing."""
    index, coverage = np.full((1, 2, RANKS), -1, np.int32), np.zeros((1, 2, RANKS), np.float32)
    index[0, 0, :2], coverage[0, 0, :2] = (1, 0), (0.5, 0.25)
    return Cryptomatte(kind, ("/B", "/A"), index, coverage)


@pytest.mark.parametrize("options", [{}, {"multipart": True}, {"multipart": True, "compression": "dwaa"}])
def test_file_has_layers_and_manifest(tmp_path, options):
    """Ranks lie in pairs in layers of 32 bits, without loss; the manifest tells which numbers are which names."""
    path = tmp_path / "a.exr"
    mattes = [matte("object"), matte("material")]
    write_image(path, np.full((1, 2, 3), 0.3, np.float32), exr=ExrOptions(cryptomattes=mattes, **options))
    for kind in ("object", "material"):
        first = read_image(path, f"crypto_{kind}00")
        assert first[0, 0].tolist() == [float_id("/A"), 0.5, float_id("/B"), 0.25] and not first[0, 1].any()
        assert not read_image(path, f"crypto_{kind}02").any()
    file = oiio.ImageInput.open(str(path))
    found = {a.name.split("/")[-1]: a.value for a in file.spec().extra_attribs if a.name.startswith("cryptomatte/")}
    keys = {a.name.split("/")[1] for a in file.spec().extra_attribs if a.name.startswith("cryptomatte/")}
    file.close()
    assert len(keys) == 2 and all(len(key) == 7 for key in keys)
    assert found["hash"] == "MurmurHash3_32" and found["conversion"] == "uint32_to_float32"
    assert json.loads(found["manifest"]) == {name: f"{float_bits(name):08x}" for name in ("/A", "/B")}
    with pytest.raises(ir.InputError, match="has no layer 'crypto_asset00'"):
        read_image(path, "crypto_asset00")


def test_lossy_compression_is_refused_for_numbers():
    """In one part dwaa would change the numbers."""
    with pytest.raises(ir.InputError, match="dwaa would change Cryptomattes"):
        ExrOptions(compression="dwaa", cryptomattes=[matte()])


def quad(name, left, right, material):
    """A rectangle in the plane z = 0, from y = 0 to y = 4."""
    points = np.array([[left, 0, 0], [right, 0, 0], [right, 4, 0], [left, 4, 0]], np.float64)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return ir.Mesh(name, points, triangles, np.full(2, material, np.int32))


@pytest.mark.extended
def test_coverage_is_the_area(device):
    """Edges at halves and quarters of pixels: of 64 points of a (0, 2)-sequence exactly so many lie on either side.

    Two objects share a name, and so their coverage; two share a material.
    """
    meshes = (quad("/A", 0.0, 1.5, 0), quad("/B", 1.5, 1.75, 1), quad("/A", 1.75, 3.25, 1))
    materials = (ir.Material("/Red"), ir.Material())
    at = np.eye(4)
    at[2, 3] = 5.0
    camera = ir.Camera(world_from_camera=at, window=(0.0, 4.0, 0.0, 4.0), projection=ir.Projection.ORTHOGRAPHIC)
    scene = ir.Scene(meshes=meshes, materials=materials, camera=camera)
    renderer = ir.Renderer(scene, ir.RenderSettings(width=4, height=4, light_paths=1, iterations=1), device=device)
    objects, materials = renderer.cryptomattes()
    assert objects.names == ("/A", "/B") and materials.names == ("/Red", "default")
    for row in range(4):
        assert objects.index[row, :, :2].tolist() == [[0, -1], [0, 1], [0, -1], [0, -1]]
        np.testing.assert_array_equal(objects.coverage[row, :, :2], [[1, 0], [0.75, 0.25], [1, 0], [0.25, 0]])
        assert sorted(materials.index[row, 1, :2]) == [0, 1]
        np.testing.assert_array_equal(materials.coverage[row, 1, :3], [0.5, 0.5, 0])
    film = renderer.new_film()
    for iteration in range(64):
        renderer.add_iteration(film, iteration)
    np.testing.assert_array_equal(objects.coverage.sum(axis=-1), film.aov("alpha"))
