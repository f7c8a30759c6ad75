"""What a `LiveScene` is made of, on the host: prototypes, and the instances that place them in worlds."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from warp_ir.scene import Bools, Floats, InputError, Instances, Ints, Mesh, Scene, materials_of, triangle_areas


@dataclass(frozen=True)
class Bodies:
    """The prototypes of a scene, and one row for each instance."""

    scene: Scene
    """Every mesh is part of one `Instances`, the prototypes; their matrices are not used."""
    mesh_indices: list[int]
    """The index in the user's scene of each mesh."""
    names: list[str]
    """Name of each instance: that of its mesh or of its `Instances`."""
    prototype: Ints
    """[n], index of the prototype."""
    matrices: Floats
    """world_from_prototype, float64 [n, 4, 4]."""
    colors: Floats
    """float32 [n, 3]."""
    emits: "list[bool]"
    """Whether each prototype emits; it has one instance then, in whose place its geometry is stored."""
    deforms: "list[bool]"
    """Whether the points of each prototype may change; it has one instance then."""

    @property
    def count(self) -> int:
        """Number of instances."""
        return len(self.prototype)

    def meshes(self, prototype: int) -> list[Mesh]:
        """The meshes of a prototype."""
        return [self.scene.meshes[k] for k in self.scene.instances[prototype].meshes]


def bodies_of(scene: Scene, deforming: Collection[str]) -> Bodies:
    """Every mesh of a scene as a prototype of one instance, and its `Instances` as they are.

    Args:
        scene: The scene.
        deforming: Names of meshes whose points may change.

    Raises:
        InputError: A mesh that deforms is instanced or emits.
    """
    emissive = {k for k, material in enumerate(scene.materials) if max(material.emission) > 0.0}
    instanced = scene.instanced()
    units = [
        Instances(mesh.name, (k,), np.eye(4)[None]) for k, mesh in enumerate(scene.meshes) if k not in instanced
    ] + list(scene.instances)
    meshes: list[Mesh] = []
    groups: list[Instances] = []
    indices: list[int] = []
    names: list[str] = []
    prototypes: list[int] = []
    matrices: list[Floats] = [np.zeros((0, 4, 4))]
    colors: list[Floats] = [np.zeros((0, 3))]
    emits: list[bool] = []
    deforms: list[bool] = []

    def add(unit: Instances, ks: list[int], *, own_points: bool, emitting: bool, deforming: bool) -> None:
        for k in ks:
            mesh = scene.meshes[k]
            if own_points:
                mesh = replace(mesh, points=np.array(mesh.points))  # not shared with another copy
            if deforming:
                mesh = replace(mesh, normals=None, tangents=None)
            meshes.append(mesh)
            indices.append(k)
        own = tuple(range(len(meshes) - len(ks), len(meshes)))
        tint = None if unit.colors is None else np.zeros((1, 3), np.float32)
        groups.append(Instances(unit.name, own, np.eye(4)[None], tint))
        emits.append(emitting)
        deforms.append(deforming)

    for unit in units:
        ks = [k for k in unit.meshes if len(scene.meshes[k].triangles)]
        if not ks:
            continue
        emitting = any(k in emissive for mesh in ks for k in materials_of(scene.meshes[mesh]))
        deformable = unit.name in deforming
        count = len(unit.matrices)
        if deformable and (emitting or count != 1 or len(ks) != 1):
            raise InputError(f"{unit.name}: a mesh that deforms must be one mesh, drawn once, that does not emit")
        for _ in range(count if emitting else 1):
            add(unit, ks, own_points=emitting or deformable, emitting=emitting, deforming=deformable)
        first = len(groups) - (count if emitting else 1)
        prototypes += [first + k for k in range(count)] if emitting else [first] * count
        names += [unit.name] * count
        matrices.append(unit.matrices)
        colors.append(np.zeros((count, 3)) if unit.colors is None else unit.colors)
    missing = set(deforming) - set(names)
    if missing:
        raise InputError(f"{sorted(missing)[0]}: there is no mesh of that name to deform")
    return Bodies(
        scene=replace(scene, meshes=tuple(meshes), instances=tuple(groups), shutter=()),
        mesh_indices=indices,
        names=names,
        prototype=np.array(prototypes, np.int64),
        matrices=np.concatenate(matrices),
        colors=np.concatenate(colors).astype(np.float32),
        emits=emits,
        deforms=deforms,
    )


def rotations_and_stretches(matrices: Floats) -> tuple[Floats, Floats]:
    """The polar decomposition M = R P of matrices [n, 3, 3] into rotations and what is left, scale and shear."""
    u, s, vt = np.linalg.svd(matrices)
    rotation = u @ vt
    mirrored = np.linalg.det(rotation) < 0.0
    rotation[mirrored] *= -1.0
    stretch = np.swapaxes(vt, 1, 2) @ (s[:, :, None] * vt)
    stretch[mirrored] *= -1.0
    return rotation, stretch


def quaternions(rotations: Floats) -> Floats:
    """Unit quaternions (x, y, z, w) of rotation matrices [n, 3, 3], from the largest of four squares (Shepperd)."""
    m = rotations
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    squares = np.stack([*(1.0 + 2.0 * m[:, k, k] - trace for k in range(3)), 1.0 + trace], axis=1)
    out = np.empty((len(m), 4))
    largest = squares.argmax(axis=1)
    for k in range(4):
        chosen = largest == k
        a, root = m[chosen], 2.0 * np.sqrt(squares[chosen, k])
        if k == 3:
            xyz = [a[:, 2, 1] - a[:, 1, 2], a[:, 0, 2] - a[:, 2, 0], a[:, 1, 0] - a[:, 0, 1]]
            out[chosen] = np.stack([*(x / root for x in xyz), 0.25 * root], axis=1)
            continue
        i, j = (k + 1) % 3, (k + 2) % 3
        out[chosen, k] = 0.25 * root
        out[chosen, i] = (a[:, i, k] + a[:, k, i]) / root
        out[chosen, j] = (a[:, j, k] + a[:, k, j]) / root
        out[chosen, 3] = (a[:, j, i] - a[:, i, j]) / root
    return out


def areas(bodies: Bodies) -> Floats:
    """The area of each instance in world space [n], for a uniform scale of the same volume."""
    own = np.array([sum(triangle_areas(m).sum() for m in bodies.meshes(k)) for k in range(len(bodies.emits))])
    scale = np.abs(np.linalg.det(bodies.matrices[:, :3, :3])) ** (2.0 / 3.0)
    return np.asarray(own[bodies.prototype] * scale if bodies.count else np.zeros(0))


def balls(bodies: Bodies) -> Floats:
    """Bounding balls of the instances in world space: x, y, z, radius; [n, 4]."""
    boxes = []
    for k in range(len(bodies.emits)):
        corners = np.concatenate([m.points[np.unique(m.triangles)] for m in bodies.meshes(k)])
        boxes.append((corners.min(axis=0), corners.max(axis=0)))
    lower, upper = (np.array([b[side] for b in boxes]).reshape(-1, 3)[bodies.prototype] for side in range(2))
    linear = bodies.matrices[:, :3, :3]
    with np.errstate(invalid="ignore"):
        centre = np.einsum("nij,nj->ni", linear, 0.5 * (lower + upper)) + bodies.matrices[:, :3, 3]
        stretch = np.linalg.norm(linear, ord=2, axis=(1, 2))
        return np.concatenate([centre, (0.5 * np.linalg.norm(upper - lower, axis=1) * stretch)[:, None]], axis=1)


_MUCH_LARGER = 8.0
"""Radius of a body, relative to the ball around all smaller ones of its world, from which on it is a background."""


def backgrounds(bodies: Bodies, group: Ints, groups: int) -> Bools:
    """Which instances are much larger than what happens in their world, as grounds and backdrops are, bool [n]."""
    every = balls(bodies)
    out = np.zeros(bodies.count, bool)
    for g in range(groups):
        rows = np.flatnonzero((group == g) & np.isfinite(every).all(axis=1))
        rows = rows[np.argsort(every[rows, 3], kind="stable")]
        own = every[rows]
        lower = np.minimum.accumulate(own[:, :3] - own[:, 3:], axis=0)
        upper = np.maximum.accumulate(own[:, :3] + own[:, 3:], axis=0)
        radius = 0.5 * np.linalg.norm(upper - lower, axis=1)
        larger = np.flatnonzero(own[1:, 3] > _MUCH_LARGER * radius[:-1])
        if len(larger):
            out[rows[1 + larger[0] :]] = True
    return out


def world_balls(bodies: Bodies, group: Ints, world_count: int, bounded: Bools) -> Floats:
    """The ball of details of each world, and last of what all worlds share: x, y, z, radius; [worlds + 1, 4].

    It holds the world's bounded bodies. A world without any has that of the shared ones.
    """
    every = balls(bodies)
    usable = bounded & np.isfinite(every).all(axis=1)
    out = np.tile([0.0, 0.0, 0.0, 1.0], (world_count + 1, 1))
    for g in (world_count, *range(world_count)):
        own = every[usable & (group == g)]
        if not len(own) and g < world_count:
            out[g] = out[world_count]
            continue
        own = own if len(own) else every[usable]
        if not len(own):
            continue
        lower, upper = (own[:, :3] - own[:, 3:]).min(axis=0), (own[:, :3] + own[:, 3:]).max(axis=0)
        centre = 0.5 * (lower + upper)
        out[g, :3] = centre
        out[g, 3] = max(float((np.linalg.norm(own[:, :3] - centre, axis=1) + own[:, 3]).max()), 1.0e-6)
    return out
