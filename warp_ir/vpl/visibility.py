"""What is known of the visibility of VPLs from the parts of a picture; `guiding.visibility` learns it.

The VPLs of a set follow a Z-order curve. Sections of equal numbers of them, one in each of `CELLS`, are about the same
part of space, or of the sky, in every set and iteration. So for each tile of 8 x 8 pixels and each section it can be
learned which share v of its light is visible. If VPLs are drawn in proportion to f q, with the share V of them that is
visible, the second moment of a draw is S Σ f V/q, S = Σ f q, which is least for q = √v.
"""

import warp as wp

from warp_ir.device.launcher import Launcher
from warp_ir.tiles import TILE

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

CELLS = 64
"""Sections of a set: four for each of the sixteen lanes, which follow one another along the curve."""
_CELLS = wp.constant(CELLS)
CELLS_OF_LANE = wp.constant(4)
_LANES = wp.constant(CELLS // CELLS_OF_LANE)


@wp.struct
class TileVisibility:
    """The learned visibility of the tiles that a film shows, by their places in the image."""

    first_column: int  # of the tiles, in tiles of the image
    first_row: int
    columns: int  # 0: nothing has been learned
    rows: int
    to_lights: wp.array[wp.float32]  # [tiles, 4, 16]: √v of VPLs on lights, section 4 lane + k in row k
    to_surfaces: wp.array[wp.float32]  # of VPLs on surfaces
    rays: wp.array[wp.vec2i]  # [tiles], shadow rays to VPLs on lights and on surfaces


@wp.func
def tile_of(visibility: TileVisibility, column: int, row: int) -> int:
    """The tile of a pixel, given by its place in the image; -1 if nothing has been learned."""
    if visibility.columns == 0:
        return -1
    x = wp.clamp(column // TILE - visibility.first_column, 0, visibility.columns - 1)
    y = wp.clamp(row // TILE - visibility.first_row, 0, visibility.rows - 1)
    return y * visibility.columns + x


@wp.func
def section_begin(section: int, blocks: int) -> int:
    """The first of the `blocks` VPLs of a lane that is in one of its `CELLS_OF_LANE` sections."""
    return (section * blocks + CELLS_OF_LANE - 1) // CELLS_OF_LANE


@wp.func
def factor_row(tile: int, section: int) -> int:
    """Where the factors of the sixteen lanes begin for VPLs of one section; -1 if nothing has been learned."""
    if tile < 0:
        return -1
    return (tile * CELLS_OF_LANE + section) * _LANES


def nothing_learned(launcher: Launcher) -> TileVisibility:
    """The record without tiles: VPLs are drawn as if all were visible."""
    out = TileVisibility()
    out.to_lights = out.to_surfaces = launcher.empty(1, wp.float32)
    out.rays = launcher.empty(1, wp.vec2i)
    return out
