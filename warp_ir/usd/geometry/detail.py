"""How finely curves, points and patches are tessellated: as finely as the camera shows them."""

from dataclasses import dataclass

import numpy as np

from warp_ir.scene import Camera, Floats, Projection

TOLERANCE = 1.0 / 3.0
"""Maximum distance in pixels between the outline of a shape and that of its triangles."""
_PIXELS = 1920
"""Assumed width of the picture in pixels."""
_PIXELS_ACROSS = 2000.0
"""Pixels from corner to corner of a prim's box, if the camera is not known."""


@dataclass(frozen=True, eq=False)
class PixelSize:
    """The size of a pixel in the world."""

    size: float
    """Size in scene units: at distance 1 from the eye, or everywhere without an eye."""
    eye: Floats | None = None
    """Position [3] of a perspective camera; None: the camera is orthographic."""

    def pixels_per_unit(self, points: Floats, matrices: Floats) -> Floats:
        """Pixels per unit of a prim's space at each of its points [n, 3], largest over its instances; float64 [n].

        With several instances, all points have the density of the nearest one's nearest point.

        Args:
            points: Points of the prim in its own space.
            matrices: world_from_prim of its instances, [k, 4, 4].
        """
        scale = np.linalg.norm(matrices[:, :3, :3], axis=1).max(axis=1)
        if self.eye is None:
            return np.full(len(points), scale.max() / self.size)
        if len(matrices) == 1:
            world = points @ matrices[0, :3, :3].T + matrices[0, :3, 3]
            distance = np.linalg.norm(world - self.eye, axis=1)
            density: Floats = scale[0] / (self.size * np.maximum(distance, 1e-30))
            return density
        lower, upper = points.min(axis=0), points.max(axis=0)
        radius = 0.5 * scale * float(np.linalg.norm(upper - lower))
        centers = matrices[:, :3, :3] @ (0.5 * (lower + upper)) + matrices[:, :3, 3]
        distances = np.linalg.norm(centers - self.eye, axis=1) - radius
        return np.full(len(points), np.max(scale / (self.size * np.maximum(distances, 1e-3 * radius + 1e-30))))


def pixel_size(camera: Camera) -> PixelSize:
    """The size of a pixel in the picture of a camera."""
    left, right, _, _ = camera.window
    eye = camera.world_from_camera[:3, 3] if camera.projection == Projection.PERSPECTIVE else None
    return PixelSize(max(right - left, 1e-30) / _PIXELS, eye)


def pixels_per_unit(pixel: PixelSize | None, points: Floats, matrices: Floats) -> Floats:
    """`PixelSize.pixels_per_unit`; if the camera is not known, as though the prim filled the picture."""
    if len(points) == 0:
        return np.zeros(0)
    if pixel is not None:
        return pixel.pixels_per_unit(points, matrices)
    diagonal = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
    return np.full(len(points), _PIXELS_ACROSS / diagonal if diagonal > 0.0 else _PIXELS_ACROSS)
