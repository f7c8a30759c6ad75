"""ShapingAPI: cone, focus and IES profile of a light, as a `Shaping`."""

from pxr import UsdLux

from warp_ir.scene import LightKind, Shaping
from warp_ir.usd.lights.ies import read_profile
from warp_ir.usd.lights.inputs import LightInputs
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Unreadable

_INPUTS = ("shaping:cone:angle", "shaping:cone:softness", "shaping:focus", "shaping:ies:file")


def read_shaping(inputs: LightInputs, kind: LightKind) -> Shaping | None:
    """A light's shaping; None: the schema is not applied, or has no effect.

    A dome has none, as in OpenUSD's reference renderer: it emits from all directions.

    Raises:
        Unreadable: An input has the wrong type or is not finite.
    """
    if not inputs.applied(UsdLux.ShapingAPI, *_INPUTS):
        return None
    if kind == LightKind.DOME:
        if inputs.authored(*_INPUTS):
            inputs.warn("shaping does not apply to a dome and is ignored")
        return None
    angle = min(max(inputs.number("shaping:cone:angle", 90.0), 0.0), 180.0)
    softness = min(max(inputs.number("shaping:cone:softness", 0.0), 0.0), 1.0)
    focus = max(inputs.number("shaping:focus", 0.0), 0.0)
    red, green, blue = read.color(inputs.attribute("shaping:focusTint"), inputs.time, (0.0, 0.0, 0.0))
    tint = max(red, 0.0), max(green, 0.0), max(blue, 0.0)
    profile = None
    asset = inputs.asset("shaping:ies:file")
    if asset is not None:
        try:
            scale = inputs.number("shaping:ies:angleScale", 0.0)
            profile = read_profile(asset, scale, inputs.flag("shaping:ies:normalize"))
        except Unreadable as trouble:
            inputs.warn(f"shaping:ies:file: {trouble}; the profile is ignored")
        if profile is not None and not profile.any():
            inputs.warn("shaping:ies: the profile is 0 with this angleScale: the light emits nothing")
    # Flat lights emit into a hemisphere, to which a sharp cone of 90° is equal; distant lights emit into their angle.
    full_angle = 90.0 if kind in (LightKind.RECT, LightKind.DISK, LightKind.DISTANT) else 180.0
    if kind == LightKind.DISTANT and inputs.number("angle", 0.53) > 180.0:
        full_angle = 180.0
    if angle >= full_angle and softness == 0.0 and focus == 0.0 and profile is None:
        return None
    return Shaping(angle, softness, focus, tint, profile)
