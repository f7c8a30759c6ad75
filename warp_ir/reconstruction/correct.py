"""Corrections of the filtered picture by the unfiltered mean: on edges of single pixels, then of its local level.

The first follows how bright a pixel is by chance, and would shift the mean of the picture; the second restores it.
"""

import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.film.accumulate import FilmData, emission_of
from warp_ir.reconstruction.compose import ResolvedPicture
from warp_ir.reconstruction.filter import IrradianceLayer, mean_channels, rgb
from warp_ir.reconstruction.pixel_surfaces import PixelSurfaces

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_SPACING = wp.constant(16)  # of the knots between which the gain is interpolated [pixels]
_MAX_GAIN = wp.constant(16.0)  # where the filter has lost more than that, its picture says nothing of the level
_RADIUS = wp.constant(2)  # of the window over which the noise of differences on edges is estimated [pixels]


@wp.struct
class _ReflectedRadiance:
    """Radiance of a pixel without emission."""

    direct: wp.vec3
    indirect: wp.vec3


@wp.func
def _bias_fraction(surfaces: PixelSurfaces, out: ResolvedPicture, p: int) -> wp.vec2:
    """The part of a pixel's residual that is not noise (James and Stein 1961), for direct and indirect light.

    The residuals of neighbouring pixels are pooled: if their mean square is r times what noise explains, the fraction
    1 - 1/r of the residual is bias.
    """
    ratio = wp.vec2(1.0e-30)
    weights = float(0.0)
    for dy in range(-_RADIUS, _RADIUS + 1):
        for dx in range(-_RADIUS, _RADIUS + 1):
            x = p % surfaces.columns + dx
            y = p // surfaces.columns + dy
            if x >= 0 and y >= 0 and x < surfaces.columns and y < surfaces.rows:
                d = out.edge_residual.direct[y * surfaces.columns + x]
                if d[3] >= 0.0:
                    i = out.edge_residual.indirect[y * surfaces.columns + x]
                    means = mean_channels(rgb(d), rgb(i))
                    w = 1.0 / (1.0 + 0.5 * float(dx * dx + dy * dy))
                    ratio += w * wp.cw_div(wp.cw_mul(means, means), wp.vec2(d[3], i[3]) + wp.vec2(1.0e-30))
                    weights += w
    return wp.max(wp.vec2(1.0) - wp.cw_div(wp.vec2(weights), ratio), wp.vec2(0.0))


@wp.kernel
def _correct_edges(first: int, surfaces: PixelSurfaces, out: ResolvedPicture, residual: IrradianceLayer) -> None:
    """Adds to pixels on edges the part of their residual that is bias, and stores the rest as `residual`."""
    p = first + wp.tid()
    residual.direct[p] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    if out.edge_residual.direct[p][3] >= 0.0:
        fraction = _bias_fraction(surfaces, out, p)
        direct = out.edge_residual.direct[p]
        indirect = out.edge_residual.indirect[p]
        out.rows[0, p] = out.rows[0, p] + rgb(direct) * fraction[0]
        out.rows[1, p] = out.rows[1, p] + rgb(indirect) * fraction[1]
        residual.direct[p] = direct * (1.0 - fraction[0])
        residual.indirect[p] = indirect * (1.0 - fraction[1])


@wp.func
def _filtered_radiance(film: FilmData, out: ResolvedPicture, residual: IrradianceLayer, p: int) -> _ReflectedRadiance:
    """Radiance in the picture, in its unit, if it had the film's camera rays alone; supersampled pixels have more."""
    x = _ReflectedRadiance()
    if residual.direct[p][3] >= 0.0:
        x.direct = film.direct[p] * out.scale - rgb(residual.direct[p])
        x.indirect = film.indirect[p] * out.scale - rgb(residual.indirect[p])
    else:
        x.direct = out.rows[0, p] - emission_of(film, p) * out.scale
        x.indirect = out.rows[1, p]
    return x


@wp.kernel
def _estimate_gains(
    first: int,
    surfaces: PixelSurfaces,
    film: FilmData,
    out: ResolvedPicture,
    residual: IrradianceLayer,
    gains: wp.array2d[wp.vec2],
) -> None:
    """Unfiltered over filtered radiance around a knot, weighted by its hat function, for direct and indirect light.

    Hat functions sum to 1. So the picture times the interpolated gain has exactly the sum of the unfiltered mean, as
    long as no gain is limited.
    """
    knot = first + wp.tid()
    column = (knot % gains.shape[1]) * _SPACING
    row = (knot // gains.shape[1]) * _SPACING
    unfiltered = wp.vec2(0.0)
    filtered = wp.vec2(0.0)
    for y in range(wp.max(row - _SPACING + 1, 0), wp.min(row + _SPACING, surfaces.rows)):
        for x in range(wp.max(column - _SPACING + 1, 0), wp.min(column + _SPACING, surfaces.columns)):
            p = y * surfaces.columns + x
            w = float(_SPACING - wp.abs(x - column)) * float(_SPACING - wp.abs(y - row))
            radiance = _filtered_radiance(film, out, residual, p)
            unfiltered += (w * out.scale) * mean_channels(film.direct[p], film.indirect[p])
            filtered += w * mean_channels(radiance.direct, radiance.indirect)
    gain = wp.vec2(1.0)
    for k in range(2):
        if filtered[k] > 0.0:
            gain[k] = wp.min(unfiltered[k] / filtered[k], _MAX_GAIN)
    gains[knot // gains.shape[1], knot % gains.shape[1]] = gain


@wp.func
def _gain_at(gains: wp.array2d[wp.vec2], x: int, y: int) -> wp.vec2:
    """Bilinear interpolation of the gains at a pixel."""
    column = x // _SPACING
    row = y // _SPACING
    u = float(x - column * _SPACING) / float(_SPACING)
    v = float(y - row * _SPACING) / float(_SPACING)
    above = gains[row, column] * (1.0 - u) + gains[row, column + 1] * u
    below = gains[row + 1, column] * (1.0 - u) + gains[row + 1, column + 1] * u
    return above * (1.0 - v) + below * v


@wp.kernel
def _apply_gains(
    first: int,
    surfaces: PixelSurfaces,
    film: FilmData,
    out: ResolvedPicture,
    residual: IrradianceLayer,
    gains: wp.array2d[wp.vec2],
) -> None:
    """Multiplies the reflected radiance of a pixel by the local gain.

    Where both corrections have taken away more than there is, as they can on an edge, nothing is left.
    """
    p = first + wp.tid()
    gain = _gain_at(gains, p % surfaces.columns, p // surfaces.columns)
    radiance = _filtered_radiance(film, out, residual, p)
    out.rows[0, p] = wp.max(out.rows[0, p] + radiance.direct * (gain[0] - 1.0), wp.vec3(0.0))
    out.rows[1, p] = wp.max(out.rows[1, p] + radiance.indirect * (gain[1] - 1.0), wp.vec3(0.0))


def correct(
    surfaces: PixelSurfaces, film: FilmData, out: ResolvedPicture, scratch: IrradianceLayer, launcher: Launcher
) -> None:
    """Corrects a `ResolvedPicture` by the film's means; `scratch` is overwritten."""
    pixels = surfaces.columns * surfaces.rows
    launcher.launch(_correct_edges, pixels, [surfaces, out, scratch])
    gains = launcher.empty((surfaces.rows // _SPACING + 2, surfaces.columns // _SPACING + 2), wp.vec2)
    launcher.launch(_estimate_gains, gains.shape[0] * gains.shape[1], [surfaces, film, out, scratch, gains])
    launcher.launch(_apply_gains, pixels, [surfaces, film, out, scratch, gains])
