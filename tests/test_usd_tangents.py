"""Tangents of normal maps: shared where surface and texture go on, apart where they do not."""

import numpy as np
import pytest

from tests.stages import RAW, UNPACK, load, mesh, textured, write_image
from warp_ir.usd.geometry.tangents import smooth_tangents

FOLD = np.array([(0, 0, 0), (0, 0, -1), (1, 0, 0), (1, 0, -1), (0, 1, 0), (0, 1, -1)], float)
TRIANGLES = np.array([[0, 2, 3], [0, 3, 1], [4, 0, 1], [4, 1, 5]])
HALF = np.sqrt(0.5)


def fold(smooth=True, mirrored=False, seam=0.0):
    """A floor and a wall that meet at x = 0, u across both; their corners, with a common normal there or not."""
    along = np.array([0, 0, 1, 1, -1, -1], float)  # u of the points
    u = along[TRIANGLES]
    u[2:] = (-u[2:] if mirrored else u[2:]) + seam
    uvs = np.stack([u, -FOLD[TRIANGLES][..., 2]], axis=-1).astype(np.float32)
    flat = np.array([(0, 1, 0), (0, 1, 0), (1, 0, 0), (1, 0, 0)], float)
    normals = np.repeat(flat[:, None], 3, axis=1)
    if smooth:
        normals[FOLD[TRIANGLES][..., :2].max(axis=-1) == 0.0] = (HALF, HALF, 0.0)
    return smooth_tangents(FOLD, TRIANGLES, normals.astype(np.float32), uvs)


def test_tangents_are_shared_over_a_smooth_edge():
    """In the fold u grows halfway between down and right, by symmetry; away from it as each triangle has it."""
    tangents = fold()
    folded = FOLD[TRIANGLES][..., :2].max(axis=-1) == 0.0
    np.testing.assert_allclose(tangents[folded], np.tile((HALF, -HALF, 0.0), (folded.sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(tangents[0, 1:], [(1, 0, 0)] * 2, atol=1e-6)
    np.testing.assert_allclose(tangents[2, 0], (0, -1, 0), atol=1e-6)


@pytest.mark.parametrize("how", [{"smooth": False}, {"mirrored": True}, {"seam": 3.0}])
def test_tangents_are_apart_where_normals_or_textures_break(how):
    """A sharp edge, a mirrored texture, and a seam: each side has its own tangent, in the plane of the normal."""
    tangents = fold(**how)
    down = (0, 1, 0) if "mirrored" in how else (0, -1, 0)
    if "smooth" in how:
        np.testing.assert_allclose(tangents[:2], np.tile((1, 0, 0), (2, 3, 1)), atol=1e-6)
        np.testing.assert_allclose(tangents[2:], np.tile(down, (2, 3, 1)), atol=1e-6)
    else:
        np.testing.assert_allclose(tangents[0, 0], (HALF, -HALF, 0), atol=1e-6)
        np.testing.assert_allclose(tangents[2, 1], np.array((1, -1, 0)) * (HALF if "seam" in how else -HALF), atol=1e-6)


def test_where_textures_do_not_grow_there_is_no_tangent():
    uvs = np.zeros((4, 3, 2), np.float32)
    normals = np.tile(np.float32((0, 1, 0)), (4, 3, 1))
    assert not smooth_tangents(FOLD, TRIANGLES, normals, uvs).any()


def test_smooth_surfaces_with_normal_maps_have_tangents(tmp_path):
    """Only they: facets have their own, and other materials need none."""
    write_image(tmp_path / "a.png", np.uint8([[[200, 128, 220]]]))
    normals = "normal3f[] normals = [(0, 0, 1), (0.6, 0, 0.8), (0.6, 0, 0.8), (0, 0, 1), (0.6, 0, 0.8), (0, 0, 1)]"
    text = textured(f"{UNPACK}\n {RAW}", target="normal3f inputs:normal")
    st = "texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1), (2, 0), (2, 1)] (interpolation = 'vertex')"
    smooth, facets = load(tmp_path, text + mesh(f"{normals}\n{st}") + mesh(st, "N")).meshes
    assert facets.tangents is None and smooth.tangents.shape == (4, 3, 3)
    np.testing.assert_allclose(np.einsum("mck,mck->mc", smooth.tangents, smooth.normals), 0.0, atol=1e-6)
    assert load(tmp_path, textured() + mesh(f"{normals}\n{st}")).meshes[0].tangents is None
