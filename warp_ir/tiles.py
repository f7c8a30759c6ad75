"""Tiles of 8 x 8 pixels: the order in which pixels are processed, and the parts that adaptive sampling selects.

Pixels of a tile see similar things, so their rays are coherent, in the caches of a CPU as in a warp of GPU threads.
"""

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

TILE = 8
"""Edge length of a tile [pixels]."""


@wp.struct
class Tiles:
    """A selection of the tiles of a film."""

    columns: int  # size of the film [pixels]
    rows: int
    pixels: int  # number of pixels in the selected tiles
    numbers: wp.array[wp.int32]  # the selected tiles, counted row by row; those at the border may be cut by it
    skipped: wp.array[wp.int32]  # [all tiles], number of iterations so far that left out the tile


@wp.func
def pixel_of_tile(tiles: Tiles, tile: int, k: int) -> int:
    """The k-th of the 64 pixels of a tile; -1 outside the film."""
    across = (tiles.columns + TILE - 1) // TILE
    column = (tile % across) * TILE + k % TILE
    row = (tile // across) * TILE + k // TILE
    if column >= tiles.columns or row >= tiles.rows:
        return -1
    return row * tiles.columns + column


@wp.func
def pixel_at(tiles: Tiles, index: int) -> int:
    """The pixel of an index of a launch over `indices`; -1: there is none."""
    return pixel_of_tile(tiles, tiles.numbers[index // (TILE * TILE)], index % (TILE * TILE))


@wp.func
def skipped_iterations(tiles: Tiles, index: int) -> int:
    """Number of iterations so far that left out the pixel of an index."""
    return int(tiles.skipped[tiles.numbers[index // (TILE * TILE)]])


def all_tiles(columns: int, rows: int, launcher: Launcher) -> Tiles:
    """All tiles of a film, none of which has been left out so far."""
    count = tile_count(columns, rows)
    return some_tiles(np.ones(count, bool), np.zeros(count, np.int32), columns, rows, launcher)


def some_tiles(
    which: npt.NDArray[np.bool_], skipped: npt.NDArray[np.int32], columns: int, rows: int, launcher: Launcher
) -> Tiles:
    """The tiles selected by `which` [tiles]; `skipped` [tiles] counts the iterations that left out each tile."""
    tiles = Tiles()
    tiles.columns, tiles.rows = columns, rows
    tiles.numbers, tiles.skipped = launcher.array(np.flatnonzero(which), wp.int32), launcher.array(skipped, wp.int32)
    heights, widths = (np.minimum(TILE, size - np.arange(0, size, TILE)) for size in (rows, columns))
    tiles.pixels = int(heights @ which.reshape(len(heights), -1) @ widths)
    return tiles


def tile_count(columns: int, rows: int) -> int:
    """Number of tiles that cover a film."""
    return -(-columns // TILE) * -(-rows // TILE)


def indices(tiles: Tiles) -> int:
    """Number of indices of a launch over some tiles: 64 for each, even where the film cuts it."""
    return int(tiles.numbers.shape[0]) * TILE * TILE
