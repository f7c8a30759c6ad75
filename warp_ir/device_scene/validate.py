"""Checks of a scene before it is uploaded."""

import math
from collections.abc import Collection, Sequence

import numpy as np

from warp_ir.device.launcher import Launcher
from warp_ir.device_scene.geometry_storage import emissive_meshes
from warp_ir.image.mipmap import value_range
from warp_ir.memory import gibibytes
from warp_ir.scene import MAX_RADIANCE, InputError, LightKind, Material, Mesh, Scene, materials_of

MAX_TRIANGLES = 200_000_000
"""Largest number of triangles of a scene; one with more is rejected before anything is allocated."""
_BYTES_PER_TRIANGLE = 300
_BYTES_PER_INSTANCE = 560
"""Memory of the upload, at its peak: measured for ten million of each."""
_BYTES_PER_LIGHT_TEXEL = 53
"""Memory of the upload, at its peak, for a texel of a light's image and its cumulative probabilities: measured."""
_MAX_EXPOSED_RADIANCE = 1.0e38
"""Largest radiance times exposure, which a film stores as float32."""
_MAX_NORMAL_COMPONENT = 1.0e6
"""Largest component of a normal map, so that its square is finite."""


def check_scene(scene: Scene, launcher: Launcher, checked: Collection[int], previous: Sequence[Scene] = ()) -> None:
    """Checks shapes, indices, ranges and size of a scene: kernels do not, and a bad index would read any memory.

    Args:
        scene: The scene.
        launcher: Launcher of the device, whose memory has to suffice.
        checked: The ids of meshes and materials that need no check, because they have passed it.
        previous: Scenes on the device that it replaces.

    Raises:
        InputError: Something is not usable; the message names the mesh, material or light.
    """
    for mesh in scene.meshes:
        if id(mesh) not in checked:
            _check_mesh(mesh)
        used = materials_of(mesh)
        if used and not 0 <= used[0] <= used[-1] < len(scene.materials):
            raise InputError(f"{mesh.name}: material refers to materials outside 0..{len(scene.materials) - 1}")
    _check_instances(scene)
    triangles, copied, instances = _sizes(scene)
    if triangles > MAX_TRIANGLES:
        copies = f", {copied} of them copies of instances that emit" if copied else ""
        raise InputError(f"scene: {triangles} triangles{copies}; the limit is {MAX_TRIANGLES}")
    needed, *before = map(upload_bytes, (scene, *previous))
    held = max(before, default=0)
    if needed > held and needed > (available := launcher.memory() + held):
        texels = f" and {count} texels of lights" if (count := _light_texels(scene)) else ""
        raise InputError(
            f"scene: {triangles} triangles and {instances} instances{texels} need about {gibibytes(needed)},"
            f" {launcher.device} has {gibibytes(available)}"
        )
    for material in scene.materials:
        if id(material) in checked:
            continue
        _check_material(material)
        if not all(0.0 <= a <= 1.0 for a in material.albedo):
            raise InputError(f"{material.name}: albedo must lie in [0, 1], is {material.albedo}")
        for name, emission, image in (
            ("emission", material.emission, material.emission_texture),
            ("glow", material.glow or (0.0, 0.0, 0.0), material.glow_texture),
        ):
            if not all(0.0 <= e < MAX_RADIANCE for e in emission):
                raise InputError(f"{material.name}: {name} must be in [0, {MAX_RADIANCE:g}), is {emission}")
            if image is not None and not max(float(image.pixels.max()), *image.outside) < MAX_RADIANCE:
                raise InputError(f"{material.name}: texture {image.name}: {name} must be less than {MAX_RADIANCE:g}")
    for light in scene.lights:
        if not all(0.0 <= e < MAX_RADIANCE for e in light.radiance):
            raise InputError(f"{light.name}: radiance must be in [0, {MAX_RADIANCE:g}), is {light.radiance}")
        if light.world_from_light.shape != (4, 4) or not np.isfinite(light.world_from_light).all():
            raise InputError(f"{light.name}: world_from_light must be a finite 4x4 matrix")
        texture = light.texture
        if texture is not None:
            if light.kind not in (LightKind.RECT, LightKind.DOME):
                raise InputError(f"{light.name}: only RECT and DOME lights take a texture")
            if texture.ndim != 3 or texture.shape[2] != 3 or texture.size == 0:
                raise InputError(f"{light.name}: texture must have shape [h, w, 3]")
            if not (np.isfinite(texture).all() and texture.min() >= 0.0):
                raise InputError(f"{light.name}: texture must be finite and not negative")
            if not float(texture.max()) * max(light.radiance) < MAX_RADIANCE:
                raise InputError(f"{light.name}: radiance times texture must be less than {MAX_RADIANCE:g}")
    brightest = max([0.0, *(max(m.emission) for m in scene.materials), *(max(x.radiance) for x in scene.lights)])
    if not scene.camera.exposure * brightest < _MAX_EXPOSED_RADIANCE:
        what = f"exposure {scene.camera.exposure:g} times radiance {brightest:g} exceeds {_MAX_EXPOSED_RADIANCE:g}"
        raise InputError(f"camera {scene.camera.name!r}: {what}")


def _check_material(material: Material) -> None:
    def demand(good: "bool | np.bool_", what: str) -> None:
        if not good:
            raise InputError(f"{material.name}: {what}")

    demand(0.0 <= material.opacity <= 1.0 and 0.0 <= material.cutoff <= 1.0, "opacity and cutoff must lie in [0, 1]")
    for texture in material.textures:
        pixels = texture.pixels
        shaped = pixels.ndim == 3 and min(pixels.shape) >= 1 and pixels.shape[2] in (1, 3)
        demand(shaped, f"texture {texture.name}: pixels must have shape [h, w, 3] or [h, w, 1]")
        low, high = value_range(pixels)
        demand(math.isfinite(low) and math.isfinite(high), f"texture {texture.name}: pixels must be finite")
        signed = texture is material.normal_texture
        demand(signed or low >= 0.0, f"texture {texture.name}: pixels must not be negative")
        usable = not signed or (pixels.shape[2] == 3 and max(-low, high) <= _MAX_NORMAL_COMPONENT)
        demand(usable, f"texture {texture.name}: normals have three channels, each at most {_MAX_NORMAL_COMPONENT:g}")
        placed = texture.transform.shape == (2, 3) and np.isfinite(texture.transform.astype(np.float32)).all()
        demand(placed, f"texture {texture.name}: transform must be a finite 2x3 matrix")
        demand(np.isfinite(texture.outside).all(), f"texture {texture.name}: outside must be finite")
    gloss = material.gloss
    if gloss is not None:
        colors = (*gloss.base_color, *(gloss.specular_color or ()))
        shares = (
            gloss.metallic,
            gloss.specular_weight,
            gloss.roughness,
            gloss.clearcoat,
            gloss.clearcoat_roughness,
            *colors,
        )
        demand(all(0.0 <= x <= 1.0 for x in shares), "colours, metallic, roughness and clearcoat must lie in [0, 1]")
        demand(0.0 < gloss.ior < math.inf, f"ior must be positive, is {gloss.ior:g}")
    for bounded in (material.albedo_texture, material.opacity_texture, *(gloss.textures if gloss else ())):
        if bounded is not None:
            top = max(value_range(bounded.pixels)[1], *bounded.outside)
            demand(top <= 1.0 and min(bounded.outside) >= 0.0, f"texture {bounded.name}: values must lie in [0, 1]")


def _check_instances(scene: Scene) -> None:
    taken: set[int] = set()
    for group in scene.instances:
        count = len(group.matrices)

        def demand(good: "bool | np.bool_", what: str, name: str = group.name) -> None:
            if not good:
                raise InputError(f"{name}: {what}")

        demand(all(0 <= k < len(scene.meshes) for k in group.meshes), f"meshes outside 0..{len(scene.meshes) - 1}")
        demand(len({*group.meshes} - taken) == len(group.meshes), "a mesh is instanced twice")
        taken.update(group.meshes)
        demand(group.matrices.shape == (count, 4, 4) and count > 0, "matrices must have shape [k, 4, 4], k > 0")
        demand(np.isfinite(group.matrices).all(), "matrices must be finite")
        shaped = any((light := scene.meshes[k].light) is not None and light.shaping is not None for k in group.meshes)
        demand(not shaped, "a mesh whose emission is shaped cannot be instanced: every place has an axis of its own")
        demand((group.matrices[:, 3] == (0.0, 0.0, 0.0, 1.0)).all(), "matrices must be affine")
        if group.colors is not None:
            demand(group.colors.shape == (count, 3), "colors must have shape [k, 3], one per instance")
            demand(group.colors.min() >= 0.0 and group.colors.max() <= 1.0, "colors must lie in [0, 1]")


def upload_bytes(scene: Scene) -> int:
    """What the upload of a scene takes at its peak, beside the scene itself [bytes]."""
    triangles, _, instances = _sizes(scene)
    texels = _BYTES_PER_LIGHT_TEXEL * _light_texels(scene)
    return _BYTES_PER_TRIANGLE * triangles + _BYTES_PER_INSTANCE * instances + texels


def _light_texels(scene: Scene) -> int:
    """Number of texels of the lights' images, each counted once."""
    images = {id(light.texture): light.texture for light in scene.lights if light.texture is not None}
    return sum(image.size // 3 for image in images.values())


def _sizes(scene: Scene) -> tuple[int, int, int]:
    """Number of stored triangles, of those that are copies because their instances emit, and of instances."""
    emissive = emissive_meshes(scene)
    flattened = [(group, k) for group in scene.instances for k in group.meshes if k in emissive]
    copied = sum((len(group.matrices) - 1) * len(scene.meshes[k].triangles) for group, k in flattened)
    return scene.triangle_count + copied, copied, sum(len(group.matrices) for group in scene.instances)


def _check_mesh(mesh: Mesh) -> None:
    count = len(mesh.triangles)

    def demand(good: "bool | np.bool_", what: str) -> None:
        if not good:
            raise InputError(f"{mesh.name}: {what}")

    demand(mesh.points.ndim == 2 and mesh.points.shape[1] == 3, "points must have shape [n, 3]")
    demand(mesh.triangles.shape == (count, 3), "triangles must have shape [m, 3]")
    demand(mesh.material.shape == (count,), "material must have shape [m], one index per triangle")
    if count:
        demand(
            mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh.points),
            f"triangles refer to points outside 0..{len(mesh.points) - 1}",
        )
        demand(np.isfinite(mesh.points[mesh.triangles]).all(), "points must be finite")
    for name, corners in (("normals", mesh.normals), ("colors", mesh.colors), ("tangents", mesh.tangents)):
        if corners is not None:
            demand(corners.shape == (count, 3, 3), f"{name} must have shape [m, 3, 3]")
            demand(np.isfinite(corners).all(), f"{name} must be finite")
    for name, corners in mesh.uvs.items():
        demand(corners.shape == (count, 3, 2), f"uvs {name!r} must have shape [m, 3, 2]")
        demand(np.isfinite(corners).all(), f"uvs {name!r} must be finite")
    if mesh.bare is not None:
        demand(mesh.bare.shape == (count,) and mesh.bare.dtype == bool, "bare must have shape [m] and be of bools")
    if mesh.light is not None:
        matrix = mesh.light.world_from_light
        demand(
            matrix.shape == (4, 4) and np.isfinite(matrix).all(), "light: world_from_light must be a finite 4x4 matrix"
        )
    if mesh.colors is not None and count:
        demand(mesh.colors.min() >= 0.0 and mesh.colors.max() <= 1.0, "colors must lie in [0, 1]")
