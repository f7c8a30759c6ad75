"""The picture of a render while it is made, in a window or in the terminal."""

import sys
import time
from typing import TYPE_CHECKING

from warp_ir.scene import InputError
from warp_ir.view.access import check_display
from warp_ir.view.display import Pixels, display_pixels
from warp_ir.view.terminal import TerminalPicture, terminal_picture

if TYPE_CHECKING:
    from warp_ir.film import Film
    from warp_ir.view.window import PictureWindow

_SHARE = 0.1
"""Largest fraction of a render's time that goes into showing it."""
_FIRST_SIZE = 640, 360
"""Size of the window until there is a picture [pixels]."""
_SECONDS = 0.2
"""Shortest time between two pictures [s]."""


class FilmPreview:
    """Shows a film whenever it is due; closing the window does not end the render."""

    def __init__(self, title: str, exposure: float, tonemap: str) -> None:
        """Chooses a window, or else the terminal.

        Raises:
            InputError: There is neither a display nor a terminal that shows pictures.
        """
        self._title, self._exposure, self._tonemap = title, exposure, tonemap
        self._window: PictureWindow | None = None
        self._terminal: TerminalPicture | None = None
        self._due = 0.0
        self._open = True
        try:
            check_display()
            from warp_ir.view import window

            self._window = window.PictureWindow(title, *_FIRST_SIZE)
        except InputError:
            self._terminal = terminal_picture(sys.stderr)
            if self._terminal is None:
                text = "--preview: there is neither a display nor a terminal that shows pictures"
                raise InputError(text) from None
        self._sized = False

    @property
    def in_terminal(self) -> bool:
        """Whether the terminal shows it, which then shows no bar."""
        return self._terminal is not None

    def __call__(self, film: "Film", status: str, *, last: bool = False) -> None:
        """Handles the window's events; shows the film if that is due, or if it is the last picture."""
        if self._window is not None and self._open:
            self._open = self._window.pump()
            if not self._open:
                self._window.close()
        start = time.perf_counter()
        if not self._open or film.iterations == 0 or (start < self._due and not last):
            return
        pixels = display_pixels(film.radiance(), self._exposure, self._tonemap)
        if self._window is not None:
            self._show_in_window(self._window, pixels, status)
        elif self._terminal is not None:
            self._terminal.show(pixels, status)
        end = time.perf_counter()
        self._due = end + max((end - start) / _SHARE, _SECONDS)

    def _show_in_window(self, window: "PictureWindow", pixels: Pixels, status: str) -> None:
        if not self._sized:
            window.window.SetSize(pixels.shape[1], pixels.shape[0])
            self._sized = True
        window.show(pixels)
        window.write([status])
        window.render()

    def close(self) -> None:
        """Closes the window."""
        if self._window is not None and self._open:
            self._window.close()
        self._open = False
