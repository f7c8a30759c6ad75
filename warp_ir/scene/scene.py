"""The `Scene`: everything that an image depends on, apart from the `RenderSettings`."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warp_ir.scene.camera import Camera
from warp_ir.scene.flatten import flattened
from warp_ir.scene.measure import albedo_integral, areas_by_material, triangle_areas, world_areas, world_bounds
from warp_ir.scene.types import Floats, Instances, Light, Material, Mesh


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that an image depends on, apart from the `RenderSettings`."""

    meshes: tuple[Mesh, ...] = ()
    materials: tuple[Material, ...] = (Material(),)
    lights: tuple[Light, ...] = ()
    camera: Camera = field(default_factory=Camera)
    name: str = ""
    """Path of the file that the scene was read from, or any label for messages."""
    instances: tuple[Instances, ...] = ()
    """Which meshes are prototypes, and the transforms of their instances; all other meshes are in world space."""
    warnings: tuple[str, ...] = ()
    """What the reader skipped, approximated or guessed: one line each, beginning with the prim's path."""
    stats: Mapping[str, int] = field(default_factory=dict)
    """Counts of what the reader read and skipped, for `--stats` and `warp-ir info`."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `RenderSettings` that the file authors; `render` uses them if it is called without settings."""
    shutter: tuple["Scene", ...] = ()
    """Shutter samples for motion blur: the scene at times spaced evenly over the open interval of the camera's shutter,
    in order; their number is a power of two. Empty: nothing moves. Each iteration renders one of them. What does not
    move is the same object in all of them."""

    @property
    def glows(self) -> bool:
        """Whether any material emits, or appears emissive to the camera (`Material.glow`)."""
        return any(max(material.emission) > 0.0 or material.glow is not None for material in self.materials)

    @property
    def has_normals(self) -> bool:
        """Whether any mesh has normals of its own."""
        return any(mesh.normals is not None for mesh in self.meshes)

    @property
    def triangle_count(self) -> int:
        """Number of stored triangles: the sum over all meshes, prototypes counted once."""
        return sum(len(mesh.triangles) for mesh in self.meshes)

    @property
    def triangles_seen(self) -> int:
        """Number of triangles in world space: those of a prototype count once per instance."""
        more = sum((len(i.matrices) - 1) * sum(len(self.meshes[k].triangles) for k in i.meshes) for i in self.instances)
        return self.triangle_count + more

    def bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper corner of the meshes' bounding box, float64 [3]; a unit cube if there are none."""
        # Only points that a triangle uses count: unused points must not change the device frame.
        drawn = [x for x in self._mesh_groups() if len(x[0].triangles) and (x[1] is None or len(x[1].matrices))]
        boxes = [world_bounds(mesh, group) for mesh, group in drawn]
        if not boxes:
            return np.full(3, -0.5), np.full(3, 0.5)
        return np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)

    def balls(self) -> Floats:
        """Bounding balls of the meshes of the world and of all copies of prototypes: x, y, z, radius; [n, 4]."""
        out = [np.zeros((0, 4))]
        for mesh, group in self._mesh_groups():
            if not len(mesh.triangles):
                continue
            lower, upper = world_bounds(mesh, None)
            centre, radius = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
            if group is None:
                out.append(np.array([[*centre, radius]]))
                continue
            linear = group.matrices[:, :3, :3]
            stretch = np.linalg.norm(linear, axis=(1, 2))  # at least the largest singular value
            centres = linear @ centre + group.matrices[:, :3, 3]
            out.append(np.concatenate([centres, radius * stretch[:, None]], axis=1))
        return np.concatenate(out)

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box in scene units, the reference for relative lengths."""
        lower, upper = self.bounds()
        return float(np.linalg.norm(upper - lower))

    def area(self) -> float:
        """Total area of all surfaces in square scene units; two-sided surfaces count once."""
        return float(sum(world_areas(mesh, group).sum() for mesh, group in self._mesh_groups()))

    def mean_albedo(self) -> float:
        """Mean albedo ρ̄ of all surfaces, weighted by area and averaged over the channels (Keller 1997)."""
        albedo = np.array([m.albedo for m in self.materials], dtype=np.float64).reshape(-1, 3).mean(axis=1)
        total, reflected = 0.0, 0.0
        for mesh, group in self._mesh_groups():
            if group is None:
                by_material = areas_by_material(mesh)
                total += float(by_material.sum())
                reflected += (
                    float(by_material @ albedo[: len(by_material)]) if mesh.colors is None else albedo_integral(mesh)
                )
                continue
            area = triangle_areas(mesh)
            rho = albedo[mesh.material] if mesh.colors is None else mesh.colors.mean(axis=(1, 2))
            copies = world_areas(mesh, group)
            share = area / area.sum() if area.sum() > 0.0 else area
            means: Floats = np.full(len(copies), share @ rho)
            if group.colors is not None and mesh.bare is not None:
                bare = mesh.bare
                means = share[~bare] @ rho[~bare] + share[bare].sum() * group.colors.mean(axis=1)
            total += float(copies.sum())
            reflected += float((copies * means).sum())
        return reflected / total if total > 0.0 else 0.0

    def flat(self, meshes: Collection[int] | None = None) -> "Scene":
        """This scene with instanced meshes flattened into world space, copy after copy; mesh indices stay the same.

        Args:
            meshes: Indices of the instanced meshes to flatten; None: all.
        """
        flat, remaining = list(self.meshes), []
        for group in self.instances:
            chosen = [k for k in group.meshes if meshes is None or k in meshes]
            for k in chosen:
                flat[k] = flattened(self.meshes[k], group, self.materials)
            rest = tuple(k for k in group.meshes if k not in chosen)
            if rest:
                remaining.append(replace(group, meshes=rest))
        return replace(self, meshes=tuple(flat), instances=tuple(remaining))

    def instanced(self) -> set[int]:
        """Indices of the meshes that are prototypes of `instances`, and drawn by these alone."""
        return {k for group in self.instances for k in group.meshes}

    def _mesh_groups(self) -> list[tuple[Mesh, Instances | None]]:
        """Every mesh and the `Instances` that it is part of, or None."""
        groups = {k: group for group in self.instances for k in group.meshes}
        return [(mesh, groups.get(k)) for k, mesh in enumerate(self.meshes)]
