"""A MuJoCo model as a `Scene`: geoms of all worlds, and lights, read once."""

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from warp_ir.scene import Floats, InputError, Instances, Ints, Light, LightKind, Material, Mesh, Scene, Shaping
from warp_ir.simulation import shapes

_NO_LIGHT_AMBIENT = 0.3
"""What MuJoCo Warp takes for ambient light where a model has no light at all."""


@dataclass
class ModelScene:
    """The scene of a model, and where the rows of its instances come from."""

    scene: Scene
    worlds: Ints
    """World of each instance."""
    geoms: Ints
    """Geom of each instance."""
    unbounded: list[int]
    """Rows of infinite planes."""


def model_scene(
    mjm: mujoco.MjModel, geoms: Ints, world_count: int, heightfields: dict[int, Any], *, smooth: bool, ambient: bool
) -> ModelScene:
    """Reads a model; every geom is in every world.

    Args:
        mjm: The model.
        geoms: The geoms that are drawn.
        world_count: Number of worlds.
        heightfields: The `wp.Mesh` of each height field that is drawn.
        smooth: Whether meshes have their own normals.
        ambient: Whether there is ambient light.

    Raises:
        InputError: A geom is of a type that cannot be rendered.
    """
    data = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, data)
    rows_of: dict[tuple[Any, ...], list[int]] = {}
    for geom in geoms.tolist():
        key = int(mjm.geom_type[geom]), int(mjm.geom_dataid[geom]), tuple(mjm.geom_size[geom]), _emission(mjm, geom)
        rows_of.setdefault(key, []).append(geom)
    materials: dict[tuple[float, float, float], int] = {}
    meshes: list[Mesh] = []
    groups: list[Instances] = []
    worlds: list[Ints] = []
    sources: list[Ints] = []
    unbounded: list[int] = []
    for (kind, _, size, emission), rows in rows_of.items():
        triangles = _triangles(mjm, rows[0], heightfields, smooth)
        material = materials.setdefault(emission, len(materials))
        count = len(triangles.triangles)
        name = f"geoms {len(groups)}"
        if kind == int(mujoco.mjtGeom.mjGEOM_PLANE) and min(size[:2]) <= 0.0:
            first = sum(len(own) for own in sources)
            unbounded += range(first, first + world_count * len(rows))
        matrices = np.tile(np.eye(4), (len(rows), 1, 1))
        matrices[:, :3, :3] = data.geom_xmat[rows].reshape(-1, 3, 3) * _stretch(kind, np.array(size))
        matrices[:, :3, 3] = data.geom_xpos[rows]
        colors = np.array([geom_color(mjm, row) for row in rows], np.float32)
        groups.append(
            Instances(name, (len(meshes),), np.tile(matrices, (world_count, 1, 1)), np.tile(colors, (world_count, 1)))
        )
        meshes.append(
            Mesh(
                name,
                triangles.points,
                triangles.triangles,
                np.full(count, material, np.int32),
                normals=triangles.normals,
                bare=np.ones(count, bool),
            )
        )
        worlds.append(np.repeat(np.arange(world_count), len(rows)))
        sources.append(np.tile(rows, world_count))
    scene = Scene(
        tuple(meshes),
        tuple(Material(f"material {k}", (1.0,) * 3, emission) for emission, k in materials.items()),
        _lights(mjm, data, ambient),
        instances=tuple(groups),
    )
    empty = np.zeros(0, np.int64)
    return ModelScene(scene, np.concatenate([empty, *worlds]), np.concatenate([empty, *sources]), unbounded)


def geom_color(mjm: mujoco.MjModel, geom: int) -> Floats:
    """The colour [3] of a geom: that of its material, unless it has another than the default one."""
    own, material = mjm.geom_rgba[geom], mjm.geom_matid[geom]
    if material >= 0 and (own == (0.5, 0.5, 0.5, 1.0)).all():
        own = mjm.mat_rgba[material]
    return np.asarray(own[:3].clip(0.0, 1.0), np.float64)


def _emission(mjm: mujoco.MjModel, geom: int) -> tuple[float, float, float]:
    """The radiance that a geom emits: that of its material, times its colour."""
    material = mjm.geom_matid[geom]
    factor = float(mjm.mat_emission[material]) if material >= 0 else 0.0
    r, g, b = (factor * geom_color(mjm, geom)).tolist()
    return r, g, b


def _stretch(kind: int, size: Floats) -> Floats:
    """Scale [3] of the triangles of `_triangles` in a geom's space."""
    geom = mujoco.mjtGeom
    if kind == int(geom.mjGEOM_SPHERE):
        return np.full(3, size[0])
    if kind == int(geom.mjGEOM_CYLINDER):
        return np.array([size[0], size[0], size[1]])
    if kind in (int(geom.mjGEOM_BOX), int(geom.mjGEOM_ELLIPSOID)):
        return size
    return np.ones(3)


def _triangles(mjm: mujoco.MjModel, row: int, heightfields: dict[int, Any], smooth: bool) -> shapes.Triangles:
    """The triangles of a geom, to be stretched by `_stretch`."""
    kind, size, source = mujoco.mjtGeom(mjm.geom_type[row]), mjm.geom_size[row], int(mjm.geom_dataid[row])
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        return shapes.plane(2.0 * float(size[0]), 2.0 * float(size[1]))
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        return shapes.sphere()
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return shapes.capsule(float(size[0]), float(size[1]))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return shapes.cylinder()
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return shapes.box()
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        first, count = mjm.mesh_vertadr[source], mjm.mesh_vertnum[source]
        faces = slice(mjm.mesh_faceadr[source], mjm.mesh_faceadr[source] + mjm.mesh_facenum[source])
        normals = None
        if smooth:
            begin = mjm.mesh_normaladr[source]
            normals = mjm.mesh_normal[begin : begin + mjm.mesh_normalnum[source]][mjm.mesh_facenormal[faces]]
        points = mjm.mesh_vert[first : first + count].astype(np.float64)
        return shapes.Triangles(points, np.array(mjm.mesh_face[faces], np.int32), normals)
    if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        mesh = heightfields[source]
        return shapes.Triangles(mesh.points.numpy().astype(np.float64), mesh.indices.numpy().reshape(-1, 3))
    raise InputError(f"geom {row} is a {kind.name}, which cannot be rendered")


def _lights(mjm: mujoco.MjModel, data: mujoco.MjData, ambient: bool) -> tuple[Light, ...]:
    """The lights of a model where they are at first; diffuse light c has the irradiance π c, as in MuJoCo's formula."""
    out = []
    sky = np.zeros(3)
    if mjm.vis.headlight.active:
        sky += mjm.vis.headlight.ambient
    elif not mjm.nlight:
        sky += _NO_LIGHT_AMBIENT
    for k in np.flatnonzero(mjm.light_active).tolist():
        sky += mjm.light_ambient[k]
        color = math.pi * mjm.light_diffuse[k].astype(np.float64)
        frame = _frame_with_z(-data.light_xdir[k])
        frame[:3, 3] = data.light_xpos[k]
        casts = bool(mjm.light_castshadow[k])
        if mjm.light_type[k] == int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL):
            out.append(
                Light(f"light {k}", LightKind.DISTANT, _rgb(color), world_from_light=frame, angle=0.0, shadows=casts)
            )
            continue
        # MuJoCo's light need not fall off: the irradiance at the centre of the model is the same.
        distance = max(float(np.linalg.norm(data.light_xpos[k] - mjm.stat.center)), 1.0e-6)
        a, b, c = mjm.light_attenuation[k].tolist()
        color *= distance**2 / max(a + b * distance + c * distance**2, 1.0e-6)
        shaping = None
        if mjm.light_type[k] == int(mujoco.mjtLightType.mjLIGHT_SPOT):
            shaping = Shaping(cone_angle=float(mjm.light_cutoff[k]), focus=float(mjm.light_exponent[k]))
        out.append(
            Light(
                f"light {k}",
                LightKind.POINT,
                _rgb(color),
                world_from_light=frame,
                shaping=shaping,
                shadows=casts,
            )
        )
    if ambient and sky.max() > 0.0:
        out.append(Light("ambient", LightKind.DOME, _rgb(sky)))
    return tuple(out)


def _rgb(color: Floats) -> tuple[float, float, float]:
    r, g, b = color.tolist()
    return r, g, b


def _frame_with_z(z: Floats) -> Floats:
    """A rigid matrix [4, 4] whose z axis is given."""
    z = z / np.linalg.norm(z)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return out
