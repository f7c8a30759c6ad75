"""What a viewer changes of a scene: its lights and colours. The scene itself stays as it was read."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from warp_ir.scene import Color, Light, LightKind, Material, Scene, Texture


@dataclass(frozen=True)
class LightEdit:
    """Changes of a light, or of a material that emits."""

    gain: float = 1.0
    """Factor on what it emits."""
    on: bool = True
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """By which it is moved in world space."""

    @property
    def factor(self) -> float:
        """Factor on what it emits, 0 where it is off."""
        return self.gain if self.on else 0.0


@dataclass(frozen=True)
class Edits:
    """Changes of lights and colours by name, without those that change nothing."""

    lights: Mapping[str, LightEdit] = field(default_factory=dict)
    """By the name of a light, or of a material that emits."""
    colors: Mapping[str, Color] = field(default_factory=dict)
    """Albedo by the name of a material, or of a mesh without one."""

    def light(self, name: str) -> LightEdit:
        """The changes of a light."""
        return self.lights.get(name, LightEdit())

    def with_light(self, name: str, edit: LightEdit) -> "Edits":
        """These edits with other changes of a light."""
        lights = {**self.lights, name: edit}
        return replace(self, lights={key: value for key, value in lights.items() if value != LightEdit()})

    def with_color(self, name: str, color: Color) -> "Edits":
        """These edits with another colour of a material or mesh."""
        return replace(self, colors={**self.colors, name: color})

    def apply(self, scene: Scene) -> Scene:
        """The edited scene; what no edit names is the same object as before."""
        if not self.lights and not self.colors:
            return scene
        lights = tuple(edited for light in scene.lights if (edited := self._light(light)) is not None)
        materials = [self._material(material) for material in scene.materials]
        meshes = list(scene.meshes)
        for k, mesh in enumerate(meshes):
            if mesh.name in self.colors:
                # Triangles that a material colours keep it; a displayColor is a material, or colours at corners.
                index, unnamed = (
                    mesh.material.copy(),
                    [j for j, m in enumerate(scene.materials) if not _is_path(m.name)],
                )
                for j in set(np.unique(index).tolist()) & set(unnamed):
                    materials.append(replace(scene.materials[j], albedo=self.colors[mesh.name], albedo_texture=None))
                    index[mesh.material == j] = len(materials) - 1
                meshes[k] = replace(mesh, material=index, colors=None, bare=None)
            elif mesh.colors is not None and any(
                scene.materials[j].name in self.colors for j in np.unique(mesh.material).tolist()
            ):
                meshes[k] = replace(mesh, colors=self._corner_colors(scene, mesh.material, mesh.colors))
        return replace(scene, lights=lights, materials=tuple(materials), meshes=tuple(meshes))

    def _corner_colors(self, scene: Scene, material: np.ndarray, colors: np.ndarray) -> np.ndarray:
        """Colours at the corners of triangles [m, 3, 3], with those of the edited materials."""
        colors = colors.copy()
        for j in np.unique(material).tolist():
            if scene.materials[j].name in self.colors:
                colors[material == j] = self.colors[scene.materials[j].name]
        return colors

    def _light(self, light: Light) -> Light | None:
        """A light as edited; None: it is off."""
        edit = self.lights.get(light.name)
        if edit is None:
            return light
        if edit.factor == 0.0:
            return None
        matrix = light.world_from_light
        if any(edit.offset) and light.kind not in (LightKind.DISTANT, LightKind.DOME):
            matrix = matrix.copy()
            matrix[:3, 3] += edit.offset
        return replace(light, radiance=_scaled(light.radiance, edit.factor), world_from_light=matrix)

    def _material(self, material: Material) -> Material:
        if material.name in self.colors and _is_path(material.name):
            material = replace(material, albedo=self.colors[material.name], albedo_texture=None)
        edit = self.lights.get(material.name)
        if edit is None:
            return material
        return replace(
            material,
            emission=_scaled(material.emission, edit.factor),
            emission_texture=_scaled_texture(material.emission_texture, edit.factor),
            glow=None if material.glow is None else _scaled(material.glow, edit.factor),
            glow_texture=_scaled_texture(material.glow_texture, edit.factor),
        )


def light_names(scene: Scene) -> tuple[str, ...]:
    """Names of the lights and of the materials that emit, each named once."""
    emissive = (material.name for material in scene.materials if max(material.emission) > 0.0)
    return tuple(dict.fromkeys((*(light.name for light in scene.lights), *emissive)))


def surface_at(scene: Scene, mesh: int, position: np.ndarray) -> tuple[str, Color]:
    """The name under which the colour of a surface is edited, and its albedo.

    Args:
        scene: The scene.
        mesh: Index of the mesh.
        position: The point of the mesh [3], world space.
    """
    record = scene.meshes[mesh]
    used = np.unique(record.material)
    triangle = 0
    if len(used) > 1 or record.colors is not None:
        triangle = _nearest_triangle(scene, mesh, position)
    material = scene.materials[int(record.material[triangle])]
    albedo = material.albedo if record.colors is None else tuple(np.mean(record.colors[triangle], axis=0).tolist())
    return (material.name if _is_path(material.name) else record.name), (albedo[0], albedo[1], albedo[2])


def _nearest_triangle(scene: Scene, mesh: int, position: np.ndarray) -> int:
    """The triangle of a mesh, in any of its copies, whose centroid and plane are nearest to a point [3]."""
    record = scene.meshes[mesh]
    matrices = next((group.matrices for group in scene.instances if mesh in group.meshes), np.eye(4)[None])
    corners = record.points[record.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    best, index = np.inf, 0
    for matrix in matrices:
        local = np.linalg.solve(matrix, np.append(position, 1.0))[:3]
        # Barycentric coordinates of the projected point say how far outside of the triangle it is.
        areas = [
            np.einsum("ij,ij->i", normal, np.cross(corners[:, (k + 1) % 3] - local, corners[:, (k + 2) % 3] - local))
            for k in range(3)
        ]
        outside = np.maximum(-np.min(areas, axis=0) / size**2, 0.0) * np.sqrt(size)
        height = np.abs(np.einsum("ij,ij->i", normal, corners[:, 0] - local)) / size
        distance = outside + height
        if distance.min() < best:
            best, index = float(distance.min()), int(distance.argmin())
    return index


def _is_path(name: str) -> bool:
    """Whether a material is a prim: displayColor and its absence make materials too, which gprims share."""
    return name.startswith("/")


def _scaled(color: Color, factor: float) -> Color:
    return color[0] * factor, color[1] * factor, color[2] * factor


def _scaled_texture(texture: Texture | None, factor: float) -> Texture | None:
    if texture is None:
        return None
    return replace(texture, pixels=texture.pixels * np.float32(factor), outside=_scaled(texture.outside, factor))
