"""Irradiance by quadrature, and the checks that compare a picture with a number."""

import numpy as np

import warp_ir as ir
from warp_ir.renderer import Renderer
from warp_ir.scene import LightKind
from warp_ir.settings import GuidingSettings

ITERATIONS = {"vpl": 64, "keller": 16, "path": 512}
"""Enough of each estimator for a standard error of about a percent in the scenes of these tests."""


def render(scene, estimator, device="cpu", guiding=None, **settings):
    """A small, unfiltered picture; `guiding` is that of `Renderer`, by default its own."""
    defaults = dict(width=8, height=8, iterations=ITERATIONS[estimator], light_paths=256, filter=False)
    settings = ir.RenderSettings(estimator=estimator, **(defaults | settings))
    return Renderer(scene, settings, device=device, guiding=guiding or GuidingSettings()).render()


def assert_mean(film, expected, *, bias=0.0, sigmas=5.0):
    """The picture's mean is `expected` within its own standard error.

    The mean over pixels has at most the mean of their standard errors (all correlated, as VPLs are). `sigmas` = 5
    at 16 or more iterations is a false alarm in 10⁴ (Student's t); 1e-5 covers float32. `bias` is the part, relative,
    that the estimator is known to leave out.
    """
    mean = float(film.radiance().astype(np.float64).mean())
    allowed = sigmas * float(film.standard_error().mean()) + (1.0e-5 + bias) * abs(expected)
    assert abs(mean - expected) <= allowed, f"mean {mean:.6g}, expected {expected:.6g} ± {allowed:.2g}"


def unit_shape(kind, u, v):
    """Points [..., 3] of a light's unit shape at parameters in [0, 1]²."""
    if kind == LightKind.RECT:
        return np.stack([u - 0.5, v - 0.5, 0 * u], axis=-1)
    if kind == LightKind.DISK:
        r, phi = u, 2 * np.pi * v
        return np.stack([r * np.cos(phi), r * np.sin(phi), 0 * u], axis=-1)
    if kind == LightKind.SPHERE:
        theta, phi = np.pi * u, 2 * np.pi * v
        return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    phi = 2 * np.pi * v
    return np.stack([u - 0.5, np.cos(phi), np.sin(phi)], axis=-1)


def irradiance_at_origin(light: ir.Light, n: int = 600, factor=None) -> float:
    """E on the plane y = 0 at the origin: ∫ L cosθ cosθ' / d² dA over the light by the midpoint rule.

    `factor(u, v, direction)` multiplies the radiance at parameters u, v towards the origin. Written from the definition
    and independent of the renderer: areas and normals come from differences.
    """
    size = {
        LightKind.RECT: (light.width, light.height, 1.0),
        LightKind.DISK: (light.radius, light.radius, 1.0),
        LightKind.SPHERE: (light.radius,) * 3,
        LightKind.CYLINDER: (light.length, light.radius, light.radius),
    }[light.kind]
    matrix = light.world_from_light[:3, :3] * np.array(size)

    def place(u, v):
        return unit_shape(light.kind, u, v) @ matrix.T + light.world_from_light[:3, 3]

    h = 1.0e-4
    u, v = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n, indexing="ij")
    du = (place(u + h, v) - place(u - h, v)) / (2 * h)
    dv = (place(u, v + h) - place(u, v - h)) / (2 * h)
    area_normal = np.cross(du, dv) / n**2
    p = place(u, v)
    if light.kind in (LightKind.RECT, LightKind.DISK):  # along the light's -Z, whatever the handedness
        side = np.linalg.inv(light.world_from_light[:3, :3]).T @ np.array([0.0, 0.0, -1.0])
        area_normal = area_normal * np.sign(area_normal @ side)[..., None]
    else:
        centre = light.world_from_light[:3, 3]
        area_normal = area_normal * np.sign(np.sum(area_normal * (p - centre), axis=-1))[..., None]
    d2 = np.sum(p * p, axis=-1)
    d = np.sqrt(d2)
    cos_floor = np.maximum(p[..., 1] / d, 0.0)
    cos_light_area = np.maximum(np.sum(-p * area_normal, axis=-1) / d, 0.0)
    towards = 1.0 if factor is None else factor(u, v, -p / d[..., None])
    return float(light.radiance[0] * np.sum(towards * cos_floor * cos_light_area / d2))


def rotation(axis, degrees):
    """Right-handed about the axis 0, 1 or 2, as a 3x3 matrix on column vectors."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[j, j], matrix[j, k], matrix[k, j], matrix[k, k] = c, -s, s, c
    return matrix


def rotation_x(degrees):
    """A rotation about X as a 3x3 matrix on column vectors."""
    return rotation(0, degrees)


def placed(linear, origin=(0.0, 0.0, 0.0)):
    """A 4x4 matrix of a linear part and a place."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, origin
    return matrix


def bilinear(texels, u, v, *, periodic=False, around=False):
    """Between centres of texels [h, w] or [h, w, 3]; u runs to the right, v down.

    The image goes on at its edges, repeats (`periodic`), or repeats to the left and right alone (`around`).
    """
    h, w = texels.shape[:2]
    x, y = u * w - 0.5, v * h - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    channels = (...,) + (None,) * (texels.ndim - 2)
    fx, fy = (x - i)[channels], (y - j)[channels]

    def texel(row, column):
        row = row % h if periodic else np.clip(row, 0, h - 1)
        return texels[row, column % w if periodic or around else np.clip(column, 0, w - 1)]

    return (texel(j, i) * (1 - fx) + texel(j, i + 1) * fx) * (1 - fy) + (
        texel(j + 1, i) * (1 - fx) + texel(j + 1, i + 1) * fx
    ) * fy


def shaped(cosine, angle=90.0, softness=0.0, focus=0.0, tint=0.0):
    """UsdLux: lerp(|cos|^focus, tint, 1) · (1 - smoothstep(θ, angle (1 - softness), angle))."""
    theta = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    low = angle * (1.0 - softness)
    t = np.clip((theta - low) / max(angle - low, 1e-9), 0.0, 1.0)
    return (tint + (1.0 - tint) * np.abs(cosine) ** focus) * (1.0 - t * t * (3.0 - 2.0 * t))


def factor(shaping, cosine):
    """What a grey `Shaping` multiplies the radiance with at an angle to the axis."""
    return shaped(cosine, shaping.cone_angle, shaping.cone_softness, shaping.focus, shaping.focus_tint[0])


def assert_agree(one, two, *, outliers):
    """Per pixel the difference of two films over its standard error is a standard normal; so is the mean's.

    A share of `outliers` of all values may exceed 4.5. The shift of the mean stays within 4 standard errors, each at
    most the mean of the first film's, whose pixels may be correlated: VPLs are.
    """
    error = np.hypot(one.standard_error(), two.standard_error())
    z = (one.radiance() - two.radiance()) / np.maximum(error, 1e-12)
    assert (np.abs(z) > 4.5).mean() <= outliers
    shift = float(one.radiance().mean() - two.radiance().mean())
    assert abs(shift) < 4.0 * float(one.standard_error().mean())
