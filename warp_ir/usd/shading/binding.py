"""Material binding: resolves the bound material for the purposes that the render settings prefer."""

from collections.abc import Sequence

from pxr import Usd, UsdShade

PURPOSES = ("full", "", "preview")
"""Purposes of bindings: final renders, all purposes, previews.

The first two are the schema's fallback; "preview" is a last resort.
"""


def purposes_to_try(preferred: Sequence[str]) -> tuple[str, ...]:
    """All purposes, the preferred ones first, then "" (USD's fallback for any), then the others."""
    return tuple(dict.fromkeys([*preferred, "", *PURPOSES]))


def bound_materials(prims: Sequence[Usd.Prim], order: Sequence[str]) -> list[tuple[UsdShade.Material, str] | None]:
    """The material bound to each prim, with the purpose of its binding; None: there is none.

    One call for all prims, since USD shares the work between them.

    Args:
        prims: Gprims and GeomSubsets.
        order: Purposes; the first with a binding wins.
    """
    bound: list[tuple[UsdShade.Material, str] | None] = [None] * len(prims)
    unresolved = list(range(len(prims)))
    for k, purpose in enumerate(order):
        if not unresolved or (purpose == "" and k > 0):
            continue  # resolved together with the preceding purpose
        accepted = {purpose, ""} if "" in order[k : k + 2] else {purpose}
        materials, bindings = UsdShade.MaterialBindingAPI.ComputeBoundMaterials([prims[i] for i in unresolved], purpose)
        for i, material, binding in zip(unresolved, materials, bindings, strict=True):
            if material and _purpose_of(binding) in accepted:
                bound[i] = material, _purpose_of(binding)
        unresolved = [i for i in unresolved if bound[i] is None]
    return bound


def _purpose_of(binding: Usd.Relationship) -> str:
    """The purpose of a relationship `material:binding[:purpose]` or `material:binding:collection[:purpose]:name`."""
    parts = binding.GetName().split(":")[2:]
    if parts[:1] == ["collection"]:
        return str(parts[1]) if len(parts) > 2 else ""
    return str(parts[0]) if parts else ""
