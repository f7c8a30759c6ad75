"""OpenColorIO, by OpenImageIO: colour spaces, displays and views of the configuration that $OCIO names.

A configuration relates its colour spaces to ours by a space that both know: linear Rec. 709, or ACES2065-1, the role
aces_interchange.
"""

import functools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ir.files import special_kind
from warp_ir.image.color_space import COLOR_SPACES, REC709, from_rec709, matrix
from warp_ir.scene import InputError

Array = npt.NDArray[np.floating]
_VARIABLE = "OCIO"
_AP0 = "lin_ap0_scene"
_BRIGHTEST = 65504.0
"""Largest value that is shown; in float32 matrices would spread a larger one over all channels."""
_COMMON = (
    *((name, _AP0) for name in ("aces_interchange", _AP0, "ACES2065-1", "ACES - ACES2065-1")),
    *((name, REC709) for name in (REC709, "lin_rec709", "Linear Rec.709 (sRGB)", "Utility - Linear - sRGB")),
)
"""Names, aliases and roles of colour spaces that configurations may have, and what they are called here."""


@contextmanager
def use_config(path: str | None) -> Iterator[None]:
    """Names a configuration by $OCIO while the block runs; None: leaves the variable as it is.

    Raises:
        InputError: The configuration cannot be read.
    """
    if path is None:
        yield
        return
    previous = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = path
    try:
        _load(path)
        yield
    finally:
        if previous is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = previous


def active_config() -> "OcioConfig | None":
    """The configuration that $OCIO names: a file, or one that is built in, such as ocio://default. None: it is unset.

    Raises:
        InputError: It cannot be read.
    """
    path = os.environ.get(_VARIABLE)
    return _load(path) if path else None


def check_color_space(name: str) -> None:
    """Checks that linear pictures can be written in a colour space.

    Raises:
        InputError: It is neither one of `COLOR_SPACES` nor a linear one of the configuration.
    """
    if name in COLOR_SPACES:
        return
    config = active_config()
    if config is None:
        raise InputError(
            f"must be one of {', '.join(COLOR_SPACES)}, is {name!r}; $OCIO would add those of a configuration"
        )
    if not config.is_linear(name):
        known = ", ".join([*COLOR_SPACES, *(space for space in config.spaces if config.is_linear(space))])
        raise InputError(f"must be one of {known}, is {name!r}")


def to_color_space(colors: Array, name: str) -> npt.NDArray[np.float32]:
    """Converts linear Rec. 709 colours [..., 3] to one of `COLOR_SPACES`, or to one of the configuration."""
    if name in COLOR_SPACES:
        return from_rec709(colors, name)
    return _required_config().from_rec709(colors, name)


def check_view(display: str | None, view: str | None) -> tuple[str, str]:
    """A display and a view of the configuration; None: its default.

    Raises:
        InputError: There is no configuration, or it does not have them.
    """
    return _required_config().view(display, view)


def display_values(radiance: Array, exposure: float, view: tuple[str, str]) -> npt.NDArray[np.float32]:
    """Display values in [0, 1] of linear Rec. 709 radiance [..., 3].

    Args:
        radiance: What to show.
        exposure: Exposure [stops]; the radiance is multiplied by 2 to this power.
        view: A display and one of its views, from `check_view`.
    """
    with np.errstate(over="ignore"):
        exposed = np.clip(radiance * 2.0**exposure, -_BRIGHTEST, _BRIGHTEST).astype(np.float32)
    return np.clip(_required_config().to_display(exposed, *view), 0.0, 1.0)


def _required_config() -> "OcioConfig":
    config = active_config()
    if config is None:
        raise InputError("OpenColorIO: no configuration; $OCIO or --ocio-config names one, for example ocio://default")
    return config


class OcioConfig:
    """A configuration of OpenColorIO."""

    def __init__(self, path: str) -> None:
        """Reads a configuration.

        Raises:
            InputError: It cannot be read, or does not relate to our colour spaces.
        """
        import OpenImageIO as oiio

        self.path = path
        self._config = oiio.ColorConfig(path)
        if message := str(self._config.geterror()):
            raise InputError(f"OpenColorIO: {message.splitlines()[0]}")
        spaces = self.spaces
        aliases = (alias for space in spaces for alias in self._config.getAliases(space))
        # OpenImageIO itself would guess what spaces of unknown names are.
        self._known = {str(name).lower() for name in (*spaces, *aliases, *self._config.getRoles())}
        common = next(((theirs, ours) for theirs, ours in _COMMON if self.has_space(theirs)), None)
        if common is None:
            raise InputError(
                f"OpenColorIO: {path}: has no role aces_interchange, which would relate it to other spaces"
            )
        self._theirs, self._ours = common

    @property
    def spaces(self) -> list[str]:
        """Names of all its colour spaces."""
        return list(self._config.getColorSpaceNames())

    def has_space(self, name: str) -> bool:
        """Whether it has a colour space, alias or role of that name."""
        return name.lower() in self._known

    def is_linear(self, name: str) -> bool:
        """Whether it has a linear colour space of that name."""
        return self.has_space(name) and bool(self._config.isColorSpaceLinear(name))

    def interop_id(self, name: str) -> str:
        """The Color Interop Forum's name of a colour space; "": it has none."""
        return str(self._config.get_color_interop_id(name))

    def from_rec709(self, colors: Array, name: str) -> npt.NDArray[np.float32]:
        """Converts linear Rec. 709 colours [..., 3] to a colour space."""
        return self._converted(from_rec709(colors, self._ours), self._theirs, name)

    def to_rec709(self, colors: Array, name: str) -> npt.NDArray[np.float32]:
        """Converts colours [..., 3] of a colour space to linear Rec. 709."""
        converted = self._converted(colors, name, self._theirs)
        return np.asarray(converted @ np.linalg.inv(matrix(self._ours)).T, np.float32)

    def to_display(self, colors: Array, display: str, view: str) -> npt.NDArray[np.float32]:
        """The values by which a view of a display shows linear Rec. 709 colours [..., 3]."""
        import OpenImageIO as oiio

        source = _buffer(from_rec709(colors, self._ours))
        shown = oiio.ImageBufAlgo.ociodisplay(
            source, display, view, self._theirs, unpremult=False, inverse=False, colorconfig=self.path
        )
        return self._pixels(shown, colors.shape)

    def display_space(self, view: tuple[str, str]) -> str:
        """The colour space of what a view of a display shows."""
        return str(self._config.getDisplayViewColorSpaceName(*view))

    def view(self, display: str | None, view: str | None) -> tuple[str, str]:
        """The names of a display and of a view; None: the default.

        Raises:
            InputError: It does not have them.
        """
        displays = list(self._config.getDisplayNames())
        display = display or str(self._config.getDefaultDisplayName())
        if display not in displays:
            raise InputError(f"--ocio-display: must be one of {', '.join(displays)}, is {display!r}")
        views = list(self._config.getViewNames(display))
        view = view or str(self._config.getDefaultViewName(display))
        if view not in views:
            raise InputError(f"--ocio-view: must be one of {', '.join(views)}, is {view!r}")
        return display, view

    def _converted(self, colors: Array, source: str, target: str) -> npt.NDArray[np.float32]:
        import OpenImageIO as oiio

        converted = oiio.ImageBufAlgo.colorconvert(
            _buffer(colors), source, target, unpremult=False, colorconfig=self.path
        )
        return self._pixels(converted, colors.shape)

    def _pixels(self, buffer: Any, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
        """The pixels of an image in memory.

        Raises:
            InputError: What should have made it has failed.
        """
        import OpenImageIO as oiio

        if buffer.has_error:
            raise InputError(f"OpenColorIO: {self.path}: {str(buffer.geterror()).splitlines()[0]}")
        return np.asarray(buffer.get_pixels(oiio.FLOAT), np.float32).reshape(shape)


def _buffer(colors: Array) -> Any:
    """An image in memory with colours [..., 3]."""
    import OpenImageIO as oiio

    return oiio.ImageBuf(np.ascontiguousarray(colors, np.float32).reshape(1, -1, 3))


@functools.lru_cache(maxsize=4)
def _load(path: str) -> OcioConfig:
    if other := special_kind(path):
        raise InputError(f"OpenColorIO: {path}: is {other}, not a configuration")
    return OcioConfig(path)
