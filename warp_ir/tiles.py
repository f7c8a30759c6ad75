"""Squares of 8 x 8 pixels, one after the other: the order in which pixels are worked on, and the parts that are done.

Pixels of a square see about the same: neighbours in space are neighbours in time, and in a group of GPU threads.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ir.device.launcher import Launcher

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

TILE = 8
"""Pixels to its side."""


@wp.struct
class Tiles:
    """Some of the tiles of a film."""

    columns: int  # of the film, in pixels
    rows: int
    pixels: int  # in these tiles
    numbers: wp.array[wp.int32]  # row by row; those at the right and at the bottom may reach beyond the film
    skipped: wp.array[wp.int32]  # iterations so far that were not for a tile, of all tiles of the film


@wp.func
def pixel_of_tile(tiles: Tiles, tile: int, k: int) -> int:
    """The k-th of the 64 pixels of a tile; -1 beyond the film."""
    across = (tiles.columns + TILE - 1) // TILE
    column = (tile % across) * TILE + k % TILE
    row = (tile // across) * TILE + k // TILE
    if column >= tiles.columns or row >= tiles.rows:
        return -1
    return row * tiles.columns + column


@wp.func
def pixel_at(tiles: Tiles, index: int) -> int:
    """The pixel that an index stands for, out of `indices`; -1: none."""
    return pixel_of_tile(tiles, tiles.numbers[index // (TILE * TILE)], index % (TILE * TILE))


@wp.func
def skipped_iterations(tiles: Tiles, index: int) -> int:
    """How many iterations so far were not for that pixel."""
    return int(tiles.skipped[tiles.numbers[index // (TILE * TILE)]])


def all_tiles(columns: int, rows: int, launcher: Launcher) -> Any:
    """The `Tiles` of a film of so many pixels, none of which has been left out."""
    count = tile_count(columns, rows)
    return some_tiles(np.ones(count, bool), np.zeros(count, np.int32), columns, rows, launcher)


def some_tiles(
    which: npt.NDArray[np.bool_], skipped: npt.NDArray[np.int32], columns: int, rows: int, launcher: Launcher
) -> Any:
    """Those `Tiles` for which `which` [tiles] is true; `skipped` [tiles] are iterations that have left one out."""
    tiles = Tiles()
    tiles.columns, tiles.rows = columns, rows
    tiles.numbers, tiles.skipped = launcher.array(np.flatnonzero(which), wp.int32), launcher.array(skipped, wp.int32)
    heights, widths = (np.minimum(TILE, size - np.arange(0, size, TILE)) for size in (rows, columns))
    tiles.pixels = int(heights @ which.reshape(len(heights), -1) @ widths)
    return tiles


def tile_count(columns: int, rows: int) -> int:
    """How many tiles cover a film."""
    return -(-columns // TILE) * -(-rows // TILE)


def indices(tiles: Any) -> int:
    """How many indices a kernel runs over for some `Tiles`: those of whole ones."""
    return int(tiles.numbers.shape[0]) * TILE * TILE
