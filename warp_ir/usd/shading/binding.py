"""Which material is bound to a prim, for the purposes that render settings ask for, in their order."""

from collections.abc import Sequence

from pxr import Usd, UsdShade

PURPOSES = ("full", "", "preview")
"""Of bindings: for final renders, for all, for previews. The first two are the schema's default; the last is better
than nothing."""


def order_of(wanted: Sequence[str]) -> tuple[str, ...]:
    """All purposes that are tried: those wanted first, then "", which USD falls back to for any, then the others."""
    return tuple(dict.fromkeys([*wanted, "", *PURPOSES]))


def bound_materials(prims: Sequence[Usd.Prim], order: Sequence[str]) -> list[tuple[UsdShade.Material, str] | None]:
    """The material of each prim and the purpose that it is bound for; None: none is.

    All at once, for USD shares the work.

    Args:
        prims: Gprims and subsets of their faces.
        order: Purposes; the first for which something is bound counts.
    """
    out: list[tuple[UsdShade.Material, str] | None] = [None] * len(prims)
    left = list(range(len(prims)))
    for k, purpose in enumerate(order):
        if not left or (purpose == "" and k > 0):
            continue  # found together with the purpose before
        takes = {purpose, ""} if "" in order[k : k + 2] else {purpose}
        materials, bindings = UsdShade.MaterialBindingAPI.ComputeBoundMaterials([prims[i] for i in left], purpose)
        for i, material, binding in zip(left, materials, bindings, strict=True):
            if material and _purpose_of(binding) in takes:
                out[i] = material, _purpose_of(binding)
        left = [i for i in left if out[i] is None]
    return out


def _purpose_of(binding: Usd.Relationship) -> str:
    """`material:binding[:purpose]` or `material:binding:collection[:purpose]:name`."""
    parts = binding.GetName().split(":")[2:]
    if parts[:1] == ["collection"]:
        return str(parts[1]) if len(parts) > 2 else ""
    return str(parts[0]) if parts else ""
