"""MuJoCo Warp's rendering functions with light that bounces: the same buffers, and the same geometry in them."""

import numpy as np
import pytest
import warp as wp

mujoco = pytest.importorskip("mujoco")
mjw = pytest.importorskip("mujoco_warp")

import warp_ir as ir  # noqa: E402
import warp_ir.mujoco as gi  # noqa: E402
from warp_ir.scene import InputError  # noqa: E402

pytestmark = pytest.mark.extended

SCENE = """
<mujoco>
  <visual><headlight active="{headlight}" ambient="0 0 0" diffuse="0.4 0.3 0.2" specular="0 0 0"/></visual>
  <asset>
    <mesh name="wedge" vertex="0 0 0  .4 0 0  0 .4 0  0 0 .4"/>
    <hfield name="hills" nrow="8" ncol="8" size=".6 .6 .3 .1"/>
    <material name="red" rgba=".8 .2 .1 1"/>
  </asset>
  <worldbody>
    <light type="directional" dir=".3 .2 -1" diffuse=".6 .6 .6" specular="0 0 0" ambient="0 0 0"/>
    <geom type="plane" size="0 0 1" rgba=".5 .6 .7 1"/>
    <geom type="hfield" hfield="hills" pos="-1.4 1.2 0.05" rgba=".6 .4 .2 1"/>
    <body pos="0 0 .5"><freejoint/><geom type="sphere" size=".3" material="red"/></body>
    <body pos="1 0 .4"><freejoint/><geom type="box" size=".2 .3 .25" rgba=".3 .8 .2 1"/></body>
    <body pos="-1 0 .5"><freejoint/><geom type="capsule" size=".2 .2" rgba=".2 .3 .9 1"/></body>
    <body pos="0 1 .5"><freejoint/><geom type="cylinder" size=".25 .2" rgba=".9 .8 .1 1"/></body>
    <body pos="1 1 .5"><freejoint/><geom type="ellipsoid" size=".3 .2 .25" rgba=".7 .2 .7 1"/></body>
    <body pos="-1 -.6 .3"><freejoint/><geom type="mesh" mesh="wedge" rgba=".4 .4 .4 1"/></body>
    <camera name="a" pos="0 -4 2.5" xyaxes="1 0 0 0 .55 .83"/>
    <camera name="b" pos="3.5 -2.5 2.5" xyaxes=".55 .83 0 -.45 .3 .83" fovy="50"/>
  </worldbody>
</mujoco>
"""
BOTH = dict(render_rgb=True, render_depth=True, render_seg=True, use_textures=False)


def batch(worlds, headlight=0):
    mjm = mujoco.MjModel.from_xml_string(SCENE.format(headlight=headlight))
    mjm.hfield_data[:] = np.random.default_rng(1).uniform(0.0, 1.0, mjm.hfield_data.shape)
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    with wp.ScopedDevice("cpu"):
        return mjm, mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=worlds)


def pictures(module, m, d, rc, rows, columns, worlds, camera=0):
    module.refit_bvh(m, d, rc)
    module.render(m, d, rc)
    shape = (worlds, rows, columns)
    rgb, depth = wp.zeros(shape, dtype=wp.vec3, device="cpu"), wp.zeros(shape, dtype=float, device="cpu")
    segmentation = wp.zeros(shape, dtype=wp.vec2i, device="cpu")
    with wp.ScopedDevice("cpu"):
        mjw.get_rgb(rc, camera, rgb)
        mjw.get_depth(rc, camera, 1000.0, depth)
        mjw.get_segmentation(rc, camera, segmentation)
    return rgb.numpy(), 1000.0 * depth.numpy(), segmentation.numpy()


def inside(index):
    """Pixels whose neighbours show the same."""
    out = np.ones(index.shape, bool)
    for axis in (1, 2):
        for by in (-1, 1):
            out &= np.roll(index, by, axis) == index
    return out


@pytest.fixture(scope="module")
def pair():
    """Both renderers' pictures of two worlds by two cameras; a body of world 1 is elsewhere."""
    out = {}
    mjm, m, d = batch(2, headlight=1)
    position = d.qpos.numpy()
    position[1, :3] = 0.3, -0.6, 0.9
    d.qpos.assign(position)
    with wp.ScopedDevice("cpu"):
        mjw.kinematics(m, d)
        mjw.camlight(m, d)
    settings = ir.ViewSettings(iterations=64, max_bounces=0, filter=False, light_paths=64)
    for name, module, options in (("theirs", mjw, {"enable_specular": False}), ("ours", gi, {"settings": settings})):
        with wp.ScopedDevice("cpu"):
            rc = module.create_render_context(mjm, 2, cam_res=(48, 40), **BOTH, **options)
        out[name] = [pictures(module, m, d, rc, 40, 48, 2, camera) for camera in range(2)]
    return out


def test_geometry_is_that_of_mujoco_warp(pair):
    """Segmentation and depth are the same off edges, for all types of geoms, in all worlds and cameras.

    Curved shapes are polygons of 128 segments: 1 - cos(π/128) = 3e-4 of a radius, and more where they are seen at a
    grazing angle.
    """
    for (_, depth, index), (_, own_depth, own_index) in zip(pair["theirs"], pair["ours"], strict=True):
        same = (index == own_index).all(axis=3)
        assert same.mean() > 0.97 and same[inside(index[..., 0])].mean() > 0.995
        interior = inside(index[..., 0]) & same
        assert len(np.unique(index[..., 0])) >= 8
        error = np.abs(depth - own_depth)[interior]
        assert np.median(error) < 1.0e-4 and np.percentile(error, 98) < 5.0e-3
        assert (own_depth[own_index[..., 0] < 0] == 0.0).all()


def test_direct_light_is_that_of_mujoco_warp(pair):
    """Where nothing shadows it directional light and headlight are MuJoCo's formula, within two steps of a byte.

    Theirs has no shadows, so ours is as bright or darker but for noise of the one light, which is none.
    """
    for (rgb, _, index), (own, _, own_index) in zip(pair["theirs"], pair["ours"], strict=True):
        interior = inside(index[..., 0]) & (index == own_index).all(axis=3) & (index[..., 0] >= 0)
        difference = (own - rgb)[interior]
        assert np.percentile(difference, 99) < 4.0 / 255.0
        flat = np.isin(index[..., 0], (0, 3))[interior]  # the plane and the box: normals are the same
        assert (np.abs(difference[flat]).max(axis=1) < 2.5 / 255.0).mean() > 0.6


def test_light_bounces():
    """With bounces a picture is brighter, and where light falls on red from the side so is the ground."""
    mjm, m, d = batch(1)
    means = []
    for bounces in (0, None):
        with wp.ScopedDevice("cpu"):
            settings = ir.ViewSettings(iterations=8, max_bounces=bounces)
            rc = gi.create_render_context(mjm, 1, cam_res=(24, 24), **BOTH, settings=settings)
        means.append(pictures(gi, m, d, rc, 24, 24, 1)[0].mean())
    assert means[1] > 1.02 * means[0]


def test_what_cannot_be_rendered_is_refused():
    """Options without an effect are refused, with their name."""
    mjm, _, _ = batch(1)
    for name, value in (("render_skybox", True), ("use_precomputed_rays", False)):
        with pytest.raises(InputError, match=name), wp.ScopedDevice("cpu"):
            gi.create_render_context(mjm, 1, cam_res=(8, 8), **BOTH, **{name: value})
