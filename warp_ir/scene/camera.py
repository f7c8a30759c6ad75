"""The camera: window, lens, clipping, and fitting its window to the aspect ratio of an image."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from warp_ir.scene.types import Floats, InputError, keep_read_only

CONFORM_POLICIES = (
    "expandAperture",
    "cropAperture",
    "adjustApertureWidth",
    "adjustApertureHeight",
    "adjustPixelAspectRatio",
)
"""How a camera's window conforms to an image of another aspect ratio (UsdRender's aspectRatioConformPolicy)."""


MAX_CLIPPING_PLANES = 6
"""Maximum number of a `Camera`'s clipping planes: enough for a box."""


class Projection(IntEnum):
    """How a `Camera` maps points to its film."""

    PERSPECTIVE = 0
    ORTHOGRAPHIC = 1


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective or orthographic camera that looks along its -Z, with +Y up."""

    name: str = ""
    world_from_camera: Floats = field(default_factory=lambda: np.eye(4))
    """float64 [4, 4], rotation and translation only."""
    window: tuple[float, float, float, float] = (-0.5, 0.5, -0.5, 0.5)
    """left, right, bottom, top of the film: on the plane z = -1 (perspective) or in scene units (orthographic)."""
    projection: Projection = Projection.PERSPECTIVE
    clipping: tuple[float, float] = (0.0, math.inf)
    """Nearest and farthest depth along -Z at which camera rays hit surfaces, in scene units."""
    exposure: float = 1.0
    """Linear factor on the film's radiance (UsdGeomCamera's exposure controls; 1 by default)."""
    lens_radius: float = 0.0
    """Radius of the thin lens of a perspective camera, in scene units; 0: a pinhole camera without defocus."""
    focus_distance: float = 1.0
    """Depth along -Z that a camera with a lens has in focus, in scene units; `math.inf`: what is infinitely far."""
    clipping_planes: tuple[tuple[float, float, float, float], ...] = ()
    """At most `MAX_CLIPPING_PLANES` planes (a, b, c, d) in the camera's space: camera rays hit only surfaces where
    a x + b y + c z + d >= 0."""

    def __post_init__(self) -> None:
        keep_read_only(self, f"camera {self.name!r}", ("world_from_camera",))

    @property
    def aspect(self) -> float:
        """Width of the window over its height."""
        left, right, bottom, top = self.window
        return (right - left) / (top - bottom)

    def fit(self, width: int, height: int, policy: str = CONFORM_POLICIES[0], pixel_aspect: float = 1.0) -> "Camera":
        """This camera with its window fitted, about its centre, to the aspect ratio of an image.

        Args:
            width: Width of the image in pixels.
            height: Height of the image in pixels.
            policy: One of `CONFORM_POLICIES`: the window grows (expandAperture), shrinks (cropAperture), changes in
                one of its sides alone (adjustApertureWidth, adjustApertureHeight), or stays as it is and the pixels
                are stretched over it (adjustPixelAspectRatio).
            pixel_aspect: Width of a pixel over its height.
        """
        left, right, bottom, top = self.window
        scale = width / height * pixel_aspect / self.aspect  # 1: the window fits as it is
        scale_x, scale_y = {
            "expandAperture": (max(scale, 1.0), max(1.0 / scale, 1.0)),
            "cropAperture": (min(scale, 1.0), min(1.0 / scale, 1.0)),
            "adjustApertureWidth": (scale, 1.0),
            "adjustApertureHeight": (1.0, 1.0 / scale),
            "adjustPixelAspectRatio": (1.0, 1.0),
        }[policy]
        x, half_x = 0.5 * (left + right), 0.5 * (right - left) * scale_x
        y, half_y = 0.5 * (bottom + top), 0.5 * (top - bottom) * scale_y
        return replace(self, window=(x - half_x, x + half_x, y - half_y, y + half_y))

    def project(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Where a picture of the window's aspect shows points [n, 3]; `fit` gives a camera that aspect.

        Returns:
            Columns and rows as fractions of the picture, from its upper left corner, and depths along the view in
            scene units, [n] each; behind the camera the depth is negative.
        """
        left, right, bottom, top = self.window
        local = (np.asarray(points, np.float64) - self.world_from_camera[:3, 3]) @ self.world_from_camera[:3, :3]
        depth = -local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / depth if self.projection == Projection.PERSPECTIVE else np.ones(len(depth))
            column = (local[:, 0] * scale - left) / (right - left)
            row = (top - local[:, 1] * scale) / (top - bottom)
        return column, row, depth

    @staticmethod
    def look_at(
        eye: Sequence[float],
        target: Sequence[float],
        up: Sequence[float] = (0.0, 1.0, 0.0),
        *,
        fov: float = 45.0,
        aspect: float = 1.0,
        name: str = "",
    ) -> "Camera":
        """A perspective camera at `eye` that looks at `target`.

        Args:
            eye: Position, scene units.
            target: The point in the centre of the image.
            up: A direction that points upwards in the image; not parallel to the viewing direction.
            fov: Vertical field of view [degrees].
            aspect: Width over height of the window.
            name: A label for messages.
        """
        origin = np.asarray(eye, dtype=np.float64)
        back = origin - np.asarray(target, dtype=np.float64)
        right = np.cross(np.asarray(up, dtype=np.float64), back)
        if not (np.linalg.norm(back) > 0.0 and np.linalg.norm(right) > 0.0):
            raise InputError("camera: eye and target coincide, or up is parallel to the viewing direction")
        back /= np.linalg.norm(back)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = right, np.cross(back, right), back, origin
        y = math.tan(math.radians(fov) / 2.0)
        return Camera(name=name, world_from_camera=matrix, window=(-y * aspect, y * aspect, -y, y))
