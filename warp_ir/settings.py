"""The settings of a render: one frozen, validated record. The flags of the command line are made from its fields."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from warp_ir.image.color_space import COLOR_SPACES, REC709
from warp_ir.image.ocio import check_color_space
from warp_ir.scene import CONFORM_POLICIES, InputError

ESTIMATOR_NAMES = ("vpl", "keller", "path")
"""Names of the estimators in the order of help texts; the first is the default."""
ABSORPTION_NAMES = ("roulette", "fractional")
MAX_PIXELS = 1 << 28
"""Largest number of pixels of a picture on any machine; the available memory may allow less."""
UNLIMITED = 2**31 - 1
"""`ResolvedSettings.max_bounces` where there is no limit: more than there can be."""


def _setting(default: Any, doc: str, choices: tuple[str, ...] = ()) -> Any:
    """A field whose documentation the CLI's ``--help`` shows."""
    return field(default=default, metadata={"doc": doc, "choices": choices})


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """The settings of a render. Every value is checked on construction; an `InputError` names the field."""

    width: int = _setting(512, "width of the picture [pixels]")
    height: int | None = _setting(None, "height of the picture [pixels]; by default from the camera's aspect")
    pixel_aspect: float = _setting(1.0, "width of a pixel over its height")
    conform: str = _setting(
        CONFORM_POLICIES[0], "how the camera's window is fitted to a picture of another aspect", CONFORM_POLICIES
    )
    data_window: tuple[float, float, float, float] = _setting(
        (0.0, 0.0, 1.0, 1.0),
        "part of the picture to render: left, bottom, right and top, where 0 0 1 1 is the whole picture; pixels whose"
        " centre lies inside are rendered, and an .exr file stores their place in the picture",
    )
    depth_of_field: bool = _setting(True, "blur what is out of focus, if the camera has an f-stop")
    motion_blur: bool = _setting(True, "blur what moves while the camera's shutter is open")
    iterations: int | None = _setting(None, "stop after this many iterations (64 if no other limit is given)")
    time_limit: float | None = _setting(
        None,
        "stop after this many seconds, from the call (of the command: from its start) to the picture, whatever they are"
        " spent on; one iteration is the least",
    )
    target_error: float | None = _setting(
        None,
        "stop when the estimated relative RMS error of the picture, noise and the filter's bias, is below this; the"
        " true error is about that or smaller",
    )
    light_paths: int | None = _setting(
        None,
        "light paths per iteration; a power of two is best; by default 512 for keller, and for vpl one for every eight"
        " pixels, from 1024 to 4096, on a GPU to as many as it traces at once",
    )
    max_bounces: int | None = _setting(
        None,
        "largest number of indirect bounces: 0 = direct light only, 1 = one bounce of indirect light, ...; by default"
        " there is no limit",
    )
    estimator: str = _setting(ESTIMATOR_NAMES[0], "which algorithm computes the light", ESTIMATOR_NAMES)
    absorption: str | None = _setting(
        None,
        "how light paths end: fractional as in 1997 (the default of keller) or roulette (of vpl, always of path)",
        ABSORPTION_NAMES,
    )
    bound_radius: float = _setting(
        0.0,
        "keller only: bound the geometry term at 1/(R·extent)², R being this fraction of the scene's extent;"
        " darkens corners; 0 = unbounded",
    )
    filter: bool = _setting(
        True, "vpl only: filter the remaining noise; without the filter the picture is the unbiased mean"
    )
    denoise: bool = _setting(False, "average the filtered picture with that of Open Image Denoise (extra 'denoise')")
    visible_lights: bool = _setting(False, "show area lights and the dome to the camera")
    color_space: str = _setting(
        REC709,
        f"colour space of linear pictures (.exr, .hdr, .pfm, .npy): {', '.join(COLOR_SPACES)}, or a linear one of the"
        " OpenColorIO configuration that $OCIO names; lin_ap1_scene is ACEScg. Light is computed in linear Rec. 709;"
        " what is tone-mapped is sRGB in any case",
    )
    seed: int = _setting(0, "seed of the random scrambling; the same seed gives the same bits")

    def __post_init__(self) -> None:
        """Checks every field."""
        self._check_integer("width", 1)
        self._check_integer("height", 1, optional=True)
        self._check_integer("iterations", 1, optional=True)
        self._check_integer("light_paths", 1, 1 << 24, optional=True)
        self._check_integer("max_bounces", 0, optional=True)
        self._check_integer("seed", 0, (1 << 32) - 1)
        for name in ("time_limit", "target_error"):
            self._check(name, getattr(self, name) is None or _positive(getattr(self, name)), "a positive number")
        self._check("bound_radius", self.bound_radius == 0 or _positive(self.bound_radius), "a number of at least 0")
        self._check("pixel_aspect", _positive(self.pixel_aspect), "a positive number")
        self._check("conform", self.conform in CONFORM_POLICIES, f"one of {', '.join(CONFORM_POLICIES)}")
        try:
            check_color_space(self.color_space)
        except InputError as error:
            raise InputError(f"color_space: {error}") from None
        self._check_data_window()
        self._check("estimator", self.estimator in ESTIMATOR_NAMES, f"one of {', '.join(ESTIMATOR_NAMES)}")
        self._check("absorption", self.absorption in (None, *ABSORPTION_NAMES), f"one of {', '.join(ABSORPTION_NAMES)}")
        self._check(
            "width", self.width * (self.height or 1) <= MAX_PIXELS, f"small enough: at most {MAX_PIXELS} pixels in all"
        )

    def pixels(self) -> tuple[int, int, int, int]:
        """Left column, top row, columns and rows of the data window; the height must be set.

        It may reach beyond the picture: the first two can be negative.
        """
        assert self.height is not None
        left, bottom, right, top = self.data_window
        # Half-open, so that windows that tile the picture share no pixel.
        x0, x1 = (math.ceil(x * self.width - 0.5) for x in (left, right))
        y0, y1 = (math.ceil((1.0 - y) * self.height - 0.5) for y in (top, bottom))
        self._check("data_window", x1 > x0 and y1 > y0, "large enough to hold a pixel")
        self._check("data_window", (x1 - x0) * (y1 - y0) <= MAX_PIXELS, f"of at most {MAX_PIXELS} pixels")
        return x0, y0, x1 - x0, y1 - y0

    @property
    def iteration_limit(self) -> float:
        """Iterations after which to stop: as set; 64 if nothing is set; else unlimited."""
        if self.iterations is not None:
            return self.iterations
        return 64 if self.time_limit is None and self.target_error is None else math.inf

    def resolve(
        self, aspect: float = 1.0, guiding: "GuidingSettings | None" = None, max_paths: int = 4096
    ) -> "ResolvedSettings":
        """These settings with every default filled in.

        Args:
            aspect: Width over height of the camera's window: it gives the height where none is set.
            guiding: When light paths are guided; None: never.
            max_paths: Largest default of `light_paths` for vpl, a power of two: `Launcher.max_light_paths`.

        Raises:
            InputError: The picture has too many pixels.
        """
        height = self.height or max(1, round(self.width * self.pixel_aspect / aspect))
        keller = self.estimator == "keller"
        # For keller every VPL is a ray at every pixel. For vpl there is a light path for every eight pixels, within
        # limits: more would take longer to trace than what they light takes to gather.
        default_paths = 1 << (min(max(self.width * height // 8, 1024), max_paths).bit_length() - 1)
        values = self.to_dict() | {
            "height": height,
            "light_paths": self.light_paths or (512 if keller else default_paths),
            "max_bounces": UNLIMITED if self.max_bounces is None else self.max_bounces,
            "absorption": self.absorption or ("fractional" if keller else "roulette"),
            "filter": self.filter and self.estimator == "vpl",
            "guiding": guiding,
        }
        return ResolvedSettings(**values)

    def _check(self, name: str, good: bool, wanted: str) -> None:
        if not good:
            raise InputError(f"{name}: must be {wanted}, is {getattr(self, name)!r}")

    def _check_data_window(self) -> None:
        window = self.data_window
        numbers = isinstance(window, tuple | list) and len(window) == 4
        numbers = numbers and all(isinstance(x, int | float) and abs(x) < 1.0e4 for x in window)
        good = numbers and window[0] < window[2] and window[1] < window[3]
        self._check("data_window", good, "left, bottom, right, top with left < right and bottom < top")

    def _check_integer(self, name: str, least: int, most: int = 2**31 - 1, *, optional: bool = False) -> None:
        value = getattr(self, name)
        good = isinstance(value, int) and not isinstance(value, bool) and least <= value <= most
        limit = f" and at most {most}" if most < 2**31 - 1 else ""
        self._check(name, good or (optional and value is None), f"a whole number of at least {least}{limit}")

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain values, for metadata and statistics."""
        return dataclasses.asdict(self)


def _positive(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0.0 < value < math.inf


@dataclass(frozen=True)
class GuidingSettings:
    """When light paths are guided (`vpl` only). The mean of the picture does not depend on it; noise and time do."""

    first_iteration: int = 0
    """Iterations before this one are not guided."""
    visibility: bool = True
    """Whether shadow rays are drawn by what is learned of visibility."""


@dataclass(frozen=True, kw_only=True)
class ResolvedSettings(RenderSettings):
    """Settings in which no default is left to be filled in: what `RenderSettings.resolve` returns."""

    height: int
    light_paths: int
    max_bounces: int
    """`UNLIMITED` where there is no limit."""
    absorption: str
    guiding: GuidingSettings | None
    """None: light paths are never guided."""
