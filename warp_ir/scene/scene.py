"""Everything that a picture depends on, apart from the `RenderSettings`."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warp_ir.scene.camera import Camera
from warp_ir.scene.flatten import written_out
from warp_ir.scene.measure import area_in_world, areas_by_material, bounding_box, colored_area, triangle_areas
from warp_ir.scene.types import Floats, Instances, Light, Material, Mesh


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything a picture depends on, apart from the `RenderSettings`."""

    meshes: tuple[Mesh, ...] = ()
    materials: tuple[Material, ...] = (Material(),)
    lights: tuple[Light, ...] = ()
    camera: Camera = field(default_factory=Camera)
    name: str = ""
    """File or label the scene came from."""
    instances: tuple[Instances, ...] = ()
    """Which of the meshes are prototypes, and where those are; all other meshes are in the world as they stand."""
    warnings: tuple[str, ...] = ()
    """What was skipped, approximated or guessed: one line each, beginning with the prim's path."""
    stats: Mapping[str, int] = field(default_factory=dict)
    """Counts of what was read and what was skipped, for `--stats` and `warp-ir info`."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `RenderSettings` that the file asks for; `render` without settings of yours does so."""
    shutter: tuple["Scene", ...] = ()
    """The scene at moments spread evenly over the time in which the camera's shutter is open, in order, a power of two
    of them; empty: nothing moves. Iterations take them in turn. What does not move are the same objects in all of them.
    """

    @property
    def glows(self) -> bool:
        """Whether any surface emits, or looks as if it did."""
        return any(max(material.emission) > 0.0 or material.glow is not None for material in self.materials)

    @property
    def triangle_count(self) -> int:
        """Number of triangles over all meshes: what is stored."""
        return sum(len(mesh.triangles) for mesh in self.meshes)

    @property
    def triangles_seen(self) -> int:
        """Number of triangles in the world: those of a prototype count once for every instance."""
        more = sum((len(i.matrices) - 1) * sum(len(self.meshes[k].triangles) for k in i.meshes) for i in self.instances)
        return self.triangle_count + more

    def bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper corner of the meshes' bounding box, float64 [3]; a unit cube if there are none."""
        # Only points that a triangle uses count: stray points must not move the scene's frame.
        placed = [x for x in self._placed() if len(x[0].triangles) and (x[1] is None or len(x[1].matrices))]
        boxes = [bounding_box(mesh, group) for mesh, group in placed]
        if not boxes:
            return np.full(3, -0.5), np.full(3, 0.5)
        return np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box, in scene units: what relative lengths are relative to."""
        lower, upper = self.bounds()
        return float(np.linalg.norm(upper - lower))

    def area(self) -> float:
        """Area of all surfaces, one side each, in square scene units."""
        return float(sum(area_in_world(mesh, group).sum() for mesh, group in self._placed()))

    def mean_albedo(self) -> float:
        """Mean reflectivity ρ̄ of the surfaces, weighted by area, averaged over the channels (Keller 1997)."""
        albedo = np.array([m.albedo for m in self.materials], dtype=np.float64).reshape(-1, 3).mean(axis=1)
        total, reflected = 0.0, 0.0
        for mesh, group in self._placed():
            if group is None:
                by_material = areas_by_material(mesh)
                total += float(by_material.sum())
                reflected += (
                    float(by_material @ albedo[: len(by_material)]) if mesh.colors is None else colored_area(mesh)
                )
                continue
            area = triangle_areas(mesh)
            rho = albedo[mesh.material] if mesh.colors is None else mesh.colors.mean(axis=(1, 2))
            copies = area_in_world(mesh, group)
            share = area / area.sum() if area.sum() > 0.0 else area
            means: Floats = np.full(len(copies), share @ rho)
            if group.colors is not None and mesh.bare is not None:
                bare = mesh.bare
                means = share[~bare] @ rho[~bare] + share[bare].sum() * group.colors.mean(axis=1)
            total += float(copies.sum())
            reflected += float((copies * means).sum())
        return reflected / total if total > 0.0 else 0.0

    def flat(self, meshes: Collection[int] | None = None) -> "Scene":
        """This scene with instanced meshes written out, copy by copy; their indices stay.

        Args:
            meshes: Which; None: all of them.
        """
        written, left = list(self.meshes), []
        for group in self.instances:
            chosen = [k for k in group.meshes if meshes is None or k in meshes]
            for k in chosen:
                written[k] = written_out(self.meshes[k], group, self.materials)
            rest = tuple(k for k in group.meshes if k not in chosen)
            if rest:
                left.append(replace(group, meshes=rest))
        return replace(self, meshes=tuple(written), instances=tuple(left))

    def _placed(self) -> list[tuple[Mesh, Instances | None]]:
        """Every mesh with the instances it is part of."""
        groups = {k: group for group in self.instances for k in group.meshes}
        return [(mesh, groups.get(k)) for k, mesh in enumerate(self.meshes)]
