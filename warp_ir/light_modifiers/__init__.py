"""Light modifiers: what UsdLux adds to the physics of a light, namely shaping, light links and shadows not cast.

Only lights that use any of it have a row of `LightModifiers`; a scene without one pays a comparison.
"""

from warp_ir.light_modifiers.records import (
    LightModifiers,
    LightModifierTables,
    approximate_shaping,
    in_link_set,
    shaping_factor,
)
from warp_ir.light_modifiers.shaping_integrals import shaped_power
from warp_ir.light_modifiers.upload_modifiers import upload_light_modifiers

__all__ = [
    "LightModifierTables",
    "LightModifiers",
    "approximate_shaping",
    "in_link_set",
    "shaped_power",
    "shaping_factor",
    "upload_light_modifiers",
]
