"""The camera for Newton beside Newton's own: the same conventions, and light that Newton's formulas agree with."""

import math

import numpy as np
import pytest
import warp as wp

newton = pytest.importorskip("newton", reason="extra 'newton'")

from newton.sensors import SensorCamera as NewtonCamera  # noqa: E402

from tests.live import look_at  # noqa: E402
from warp_ir.newton import GiSettings, SensorCamera  # noqa: E402
from warp_ir.scene import InputError  # noqa: E402
from warp_ir.simulation import shapes  # noqa: E402

pytestmark = [pytest.mark.extended, pytest.mark.filterwarnings("ignore::newton.NewtonWarning")]

GREY = (0.7, 0.7, 0.7)
TILT = wp.normalize(wp.quat(0.3, 0.2, 0.1, 0.9))
IMAGES = ("depth_image", "forward_depth_image", "shape_index_image", "normal_image", "albedo_image")
UNFILTERED = GiSettings(max_bounces=0, filter=False, iterations=64)


def at(x=0.0, y=0.0, z=0.0, q=TILT):
    return wp.transform(wp.vec3(x, y, z), q)


def torus():
    """A mesh without normals."""
    n, m = 24, 12
    a, b = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.arange(m) * 2 * np.pi / m, indexing="ij")
    r = 0.3 + 0.12 * np.cos(b)
    points = np.stack([r * np.cos(a), r * np.sin(a), 0.12 * np.sin(b)], axis=2).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    quad = [i * m + j, (i + 1) % n * m + j, (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m]
    triangles = [np.stack([quad[0], quad[k], quad[k + 1]], axis=2).reshape(-1, 3) for k in (1, 2)]
    return newton.Mesh(points.astype(np.float32), np.concatenate(triangles).reshape(-1).astype(np.int32))


def shape(kind, builder, body, color=GREY):
    """Adds a shape of a kind to a body."""
    options = {
        "sphere": dict(radius=0.4),
        "box": dict(hx=0.3, hy=0.2, hz=0.35),
        "capsule": dict(radius=0.2, half_height=0.3),
        "cylinder": dict(radius=0.3, half_height=0.35),
        "cone": dict(radius=0.35, half_height=0.4),
        "ellipsoid": dict(rx=0.45, ry=0.2, rz=0.3),
        "mesh": dict(mesh=torus()),
    }[kind]
    getattr(builder, f"add_shape_{kind}")(body, color=color, **options)


KINDS = ("sphere", "box", "capsule", "cylinder", "cone", "ellipsoid", "mesh")


def world(colored=True):
    """One body of every kind, a heightfield, particles and a cloth."""
    b = newton.ModelBuilder()
    for k, kind in enumerate(KINDS):
        color = tuple(0.2 + 0.6 * ((k >> j) & 1) for j in range(3)) if colored else GREY
        shape(kind, b, b.add_body(xform=at(1.1 * (k % 4 - 1.5), 1.2 * (k // 4 - 0.5), 0.5)), color)
    data = np.random.default_rng(0).random((6, 8)).astype(np.float32) * 0.3
    field = newton.Heightfield(data=data, nrow=6, ncol=8, hx=1.0, hy=0.7)
    b.add_shape_heightfield(xform=at(0.0, 2.0, 0.0, wp.quat_identity()), heightfield=field, color=GREY)
    for k in range(4):
        b.add_particle(pos=wp.vec3(-0.6 + 0.3 * k, -1.4, 0.2), vel=wp.vec3(0.0), mass=1.0, radius=0.1)
    b.add_cloth_grid(
        pos=wp.vec3(-0.6, 1.0, 1.1),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0),
        dim_x=6,
        dim_y=5,
        cell_x=0.2,
        cell_y=0.1,
        mass=0.1,
    )
    return b


def model_of(builder, worlds=1, ground=True):
    out = newton.ModelBuilder()
    out.replicate(builder, worlds)
    if ground:
        out.add_ground_plane()
    return out.finalize(device="cpu")


def one(kind):
    """A model of one body."""
    b = newton.ModelBuilder()
    shape(kind, b, b.add_body(xform=at()))
    return b.finalize(device="cpu")


def view(camera, state, pose, size=48, fov=0.7, names=("hdr_color_image",), **options):
    """Images of one view, or of as many as there are poses."""
    poses = wp.array(np.atleast_2d(pose), dtype=wp.transformf, device="cpu")
    bundle = SensorCamera.compute_camera_rays_pinhole(size, size, camera_fov=fov, device="cpu")
    kinds = {"depth_image": wp.float32, "forward_depth_image": wp.float32, "normal_image": wp.vec3f}
    kinds |= {"hdr_color_image": wp.vec3f}
    out = {n: camera.allocate_image(len(poses), size, size, kinds.get(n, wp.uint32)) for n in names}
    camera.update(state, poses, bundle, **out, **options)
    return {name: values.numpy()[0] if len(poses) == 1 else values.numpy() for name, values in out.items()}


def inside(index, wanted=None):
    """Pixels whose eight neighbours show the same shape as they do."""
    out = np.ones(index.shape, bool) if wanted is None else index == wanted
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            out &= np.roll(index, (dy, dx), axis=(0, 1)) == index
    return out


def z_up(eye, target=(0.0, 0.0, 0.0)):
    """A camera's pose with +Z up."""
    x, y, z = eye
    pose = look_at((x, z, -y), (target[0], target[2], -target[1]))
    turn = wp.transform(wp.vec3(0.0), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * math.pi))
    return np.array(turn * wp.transform(wp.vec3(*pose[:3].tolist()), wp.quat(*pose[3:].tolist())), np.float32)


def test_images_are_those_of_newton():
    """Index, depth, normal and albedo of all types of shapes, cloth and particles equal Newton's off edges.

    A polygon of 128 segments lies within r (1 - cos(π/128)) = 3e-4 r of its circle.
    """
    model = model_of(world())
    state, pose = model.state(), z_up((3.5, -4.5, 3.5), (0.0, 0.3, 0.4))
    ours, theirs = SensorCamera(model), NewtonCamera(model)
    a, b = (view(c, state, pose, 160, names=IMAGES) for c in (ours, theirs))
    index = b["shape_index_image"]
    off_edges = inside(index)
    assert set(np.unique(index)) >= {*range(9), 0xFFFFFFFD, 0xFFFFFFFE}
    assert (a["shape_index_image"] == index)[off_edges].all()
    for name in ("depth_image", "forward_depth_image"):
        np.testing.assert_allclose(a[name][off_edges], b[name][off_edges], atol=1.0e-3)
    hit = off_edges & (index != 0xFFFFFFFF)
    n = b["normal_image"]
    for axis in (0, 1):  # off creases as well
        for step in (-1, 1):
            hit &= np.sum(n * np.roll(n, step, axis=axis), axis=2) > 0.8
    assert hit.sum() > 20000 and np.sum(a["normal_image"] * n, axis=2)[hit].min() > 0.999
    for shift in (0, 8, 16, 24):
        bytes_ = [(x["albedo_image"] >> shift & 255).astype(int)[off_edges] for x in (a, b)]
        assert np.abs(bytes_[0] - bytes_[1]).max() <= 1


@pytest.mark.parametrize("kind", KINDS[:-1])
def test_direct_light_is_newtons_formula(kind):
    """A lone convex body reflects the light of a sun and of both halves of the sky by Newton's formula, within 0.2 %.

    Nothing shadows it. The segments of curved shapes, and the dome's rows about the horizon, are 2e-4 of it.
    """
    model = one(kind)
    state, pose = model.state(), z_up((2.2, -2.5, 1.7))
    mask = inside(
        view(NewtonCamera(model), state, pose, 48, 0.35, names=("shape_index_image",))["shape_index_image"], 0
    )
    for sun in (True, False):
        means = []
        for camera in (NewtonCamera(model), SensorCamera(model, gi=UNFILTERED)):
            if sun:
                camera.create_default_light()
            camera.set_ambient_light(*(((0.0,) * 3,) if sun else ((0.4, 0.5, 0.6), (0.1, 0.1, 0.05))))
            means.append(view(camera, state, pose, 48, 0.35)["hdr_color_image"][mask].mean(axis=0))
        np.testing.assert_allclose(means[1], means[0], rtol=2.0e-3)


def test_without_light_everything_is_black():
    """Neither ambient light nor a light: hdr 0, and colour 0 with alpha 255 where something is hit."""
    model = one("box")
    config = SensorCamera.RenderConfig(enable_ambient_lighting=False)
    camera = SensorCamera(model, default_render_config=config)
    out = view(camera, model.state(), z_up((2.0, -2.0, 1.0)), 8, names=("color_image", "hdr_color_image"))
    assert out["hdr_color_image"].max() == 0.0
    assert set(np.unique(out["color_image"])) == {0, 0xFF000000}


def test_light_bounces():
    """A white floor beside a red wall is redder than the wall leaves it without bounces."""
    b = newton.ModelBuilder()
    b.add_shape_box(-1, xform=at(0.0, 0.0, -0.05, wp.quat_identity()), hx=2.0, hy=2.0, hz=0.05, color=(1.0, 1.0, 1.0))
    b.add_shape_box(-1, xform=at(0.0, 1.0, 0.5, wp.quat_identity()), hx=2.0, hy=0.05, hz=0.5, color=(1.0, 0.1, 0.1))
    model = b.finalize(device="cpu")
    out = []
    for bounces in (0, None):
        camera = SensorCamera(model, gi=GiSettings(max_bounces=bounces, iterations=8))
        camera.create_default_light(direction=wp.normalize(wp.vec3(0.0, 1.0, -1.0)))
        camera.set_ambient_light((0.0,) * 3)
        out.append(
            view(camera, model.state(), z_up((0.0, 0.5, 1.0), (0.0, 0.55, 0.0)), 8, 0.4)["hdr_color_image"].mean((0, 1))
        )
    gained = out[1] - out[0]
    assert gained[0] > 0.02 and gained[0] > 5.0 * gained[2]


def test_a_moved_model_is_a_new_one():
    """A sensor that has seen other states shows the bits of one that has not: of bodies, cloth, particles, colours."""
    model = model_of(world(), ground=True)
    first, later = model.state(), model.state()
    q = later.body_q.numpy()
    q[:, :3] += np.random.default_rng(1).random((len(q), 3)) * 0.2
    later.body_q.assign(q)
    later.particle_q.assign(later.particle_q.numpy() + np.float32([0.0, 0.05, 0.1]))
    pose, names = z_up((3.5, -4.5, 3.5), (0.0, 0.3, 0.4)), ("hdr_color_image", "depth_image")
    used, fresh = SensorCamera(model), SensorCamera(model)
    for state in (later, first):
        view(used, state, pose, 32, step=0)
    again = view(used, later, pose, 32, names=names, step=0)
    expected = view(fresh, later, pose, 32, names=names, step=0)
    assert all((again[name] == expected[name]).all() for name in names)
    colors = model.shape_color.numpy().copy()
    model.shape_color.fill_(0.5)
    grey = view(used, later, pose, 32, step=0)["hdr_color_image"]
    model.shape_color.assign(colors)
    assert (grey != expected["hdr_color_image"]).any()
    assert (view(used, later, pose, 32, step=0)["hdr_color_image"] == expected["hdr_color_image"]).all()


def test_a_model_far_away_has_the_same_bits():
    """A model 2^20 m from the origin looks like one at it: poses there are multiples of 1/8 m, and as exact as at 0.

    The ball at which photons are aimed is rounded on the host, so light may differ by float32's rounding.
    """
    pictures = []
    for far in (0.0, 2.0**20):
        builder = newton.ModelBuilder()
        for k in range(3):
            body = builder.add_body(xform=wp.transform(wp.vec3(far + k, 0.5 * k, 0.5), wp.quat_identity()))
            builder.add_shape_box(body, hx=0.4, hy=0.3, hz=0.5, color=(0.8, 0.3, 0.2))
        model = builder.finalize(device="cpu")
        pose = z_up((1.0, -4.0, 2.0), (1.0, 0.5, 0.5))
        pose[0] = far + 1.0
        names = ("hdr_color_image", "depth_image", "forward_depth_image", "normal_image", "shape_index_image")
        settings = GiSettings(light_paths=64, filter=False)
        pictures.append(view(SensorCamera(model, gi=settings), model.state(), pose, 32, names=names, step=0))
    assert (pictures[0]["shape_index_image"] == 0).any()
    light = [picture.pop("hdr_color_image") for picture in pictures]
    for name, values in pictures[0].items():
        assert (values == pictures[1][name]).all(), name
    assert np.isclose(light[0], light[1], rtol=1.0e-4, atol=1.0e-5).mean() > 0.99


def test_worlds_do_not_see_each_other():
    """Replicated worlds lie in one place; what moves in one changes no bit of another."""
    model = model_of(world(), worlds=3)
    state, pose = model.state(), z_up((3.5, -4.5, 3.5), (0.0, 0.3, 0.4))
    camera = SensorCamera(model, gi=GiSettings(light_paths=128))
    before = view(camera, state, [pose] * 3, 24, step=1)["hdr_color_image"]
    q = state.body_q.numpy()
    q[model.body_world.numpy() == 1, 2] = np.nan
    q[model.body_world.numpy() == 2, 0] += 0.3
    state.body_q.assign(q)
    after = view(camera, state, [pose] * 3, 24, step=1)["hdr_color_image"]
    assert (before[0] == after[0]).all()
    assert np.isfinite(after).all() and (before[1] != after[1]).any() and (before[2] != after[2]).any()


def test_textures_multiply_colours():
    """A checkerboard multiplies the colour of a shape, where Newton has its squares."""
    b = newton.ModelBuilder()
    b.add_shape_box(-1, xform=at(q=wp.quat_identity()), hx=1.0, hy=1.0, hz=1.0, color=(0.9, 0.5, 0.4))
    model = b.finalize(device="cpu")
    config = SensorCamera.RenderConfig(enable_textures=True)
    out = []
    for camera in (SensorCamera(model), NewtonCamera(model)):
        camera.assign_checkerboard_material(shape_indices=[0])
        out.append(
            view(camera, model.state(), z_up((0.3, -4.0, 0.5)), 64, names=("albedo_image",), render_config=config)
        )
    ours, theirs = ((x["albedo_image"] & 255).astype(int) for x in out)
    assert len(np.unique(theirs)) > 2 and (np.abs(ours - theirs) <= 2).mean() > 0.9
    plain = view(SensorCamera(model), model.state(), z_up((0.3, -4.0, 0.5)), 64, names=("albedo_image",))
    assert (plain["albedo_image"] & 255).max() > ours.max()


def test_configurations_are_honoured():
    """Particles, the global world, back faces and distance are as the configuration says."""
    model = model_of(world())
    state, pose = model.state(), z_up((3.5, -4.5, 3.5), (0.0, 0.3, 0.4))
    camera = SensorCamera(model)

    def indices(**config):
        options = SensorCamera.RenderConfig(**config)
        return set(
            np.unique(
                view(camera, state, pose, 64, names=("shape_index_image",), render_config=options)["shape_index_image"]
            )
        )

    every = indices()
    assert {8, 0xFFFFFFFE} <= every
    assert 0xFFFFFFFE not in indices(enable_particles=False)
    assert 8 not in indices(enable_global_world=False)
    assert indices(max_distance=1.0) == {0xFFFFFFFF}
    below = z_up((0.1, 0.0, -3.0))
    for cull, seen in ((True, False), (False, True)):
        config = SensorCamera.RenderConfig(enable_backface_culling=cull)
        out = view(camera, state, below, 16, names=("shape_index_image",), render_config=config)["shape_index_image"]
        assert (8 in out) == seen


def test_mistakes_are_refused():
    """Samples without anti-aliasing, missing worlds, and settings that are none."""
    model = one("box")
    camera = SensorCamera(model)
    bundle = SensorCamera.compute_camera_rays_pinhole(4, 4, camera_fov=0.5, sample_count=4, device="cpu")
    poses = wp.array([z_up((2.0, -2.0, 1.0))] * 2, dtype=wp.transformf, device="cpu")
    depth = camera.allocate_image_depth(2, 4, 4)
    with pytest.raises(ValueError, match="SSAA or MSAA"):
        camera.update(model.state(), poses, bundle, depth_image=depth)
    config = SensorCamera.RenderConfig(anti_aliasing=SensorCamera.AntiAliasing.SSAA)
    with pytest.raises(ValueError, match="worlds"):
        camera.update(model.state(), poses, bundle, depth_image=depth, render_config=config)
    with pytest.raises(InputError, match="accumulate"):
        SensorCamera(model, gi=GiSettings(accumulate="sometimes"))


def test_shapes_have_outward_triangles_and_true_normals():
    """Triangles are wound outwards; closed shapes have the volume of the true ones within 0.1 %; normals are unit."""
    volumes = {
        "box": 8.0,
        "sphere": 4.0 / 3.0 * math.pi,
        "cylinder": 2.0 * math.pi,
        "cone": 2.0 / 3.0 * math.pi,
        "capsule": math.pi * 0.25 * (2.0 * 0.7 + 4.0 / 3.0 * 0.5),
    }
    made = {"box": shapes.box(), "sphere": shapes.sphere(), "cylinder": shapes.cylinder(), "cone": shapes.cone()}
    made["capsule"] = shapes.capsule(0.5, 0.7)
    for name, solid in made.items():
        a, b, c = (solid.points[solid.triangles[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        assert abs((normal * a).sum() / 6.0 / volumes[name] - 1.0) < 1.0e-3, name
        if solid.normals is not None:
            np.testing.assert_allclose(np.linalg.norm(solid.normals, axis=2), 1.0, atol=1.0e-6)
            assert (np.einsum("ni,nki->nk", normal, solid.normals) > 0.0).all(), name
