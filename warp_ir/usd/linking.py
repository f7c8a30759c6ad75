"""Light links and shadow links: which meshes a light lights, and which cast its shadows."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from pxr import Sdf, Usd, UsdLux

from warp_ir.scene import Light, Mesh
from warp_ir.usd import value


def link(stage: Usd.Stage, lights: Sequence[Light], meshes: Sequence[Mesh]) -> tuple[Light, ...]:
    """The lights with their links to the meshes of a scene, both of them named by their prims' paths.

    Args:
        stage: Where the lights are.
        lights: Of the scene.
        meshes: Of the scene, in its order.
    """
    known: dict[Any, frozenset[int]] = {}
    linked = []
    for light in lights:
        prim = stage.GetPrimAtPath(light.name) if Sdf.Path.IsValidPathString(light.name) else None
        if prim:
            api = UsdLux.LightAPI(prim)
            unlit = _outside(api.GetLightLinkCollectionAPI(), meshes, known)
            shadowless = _outside(api.GetShadowLinkCollectionAPI(), meshes, known)
            if unlit or shadowless:
                light = replace(light, unlit=unlit, shadowless=shadowless)
        linked.append(light)
    return tuple(linked)


def is_linked(prim: Usd.Prim) -> bool:
    """Whether a light has a link that is not to everything."""
    api = UsdLux.LightAPI(prim)
    return any(_says(c) for c in (api.GetLightLinkCollectionAPI(), api.GetShadowLinkCollectionAPI()))


def _says(collection: Usd.CollectionAPI) -> bool:
    everything = value.flag(collection.GetIncludeRootAttr(), Usd.TimeCode.Default(), True)
    return not everything or collection.GetExcludesRel().HasAuthoredTargets()


def _outside(collection: Usd.CollectionAPI, meshes: Sequence[Mesh], known: dict[Any, frozenset[int]]) -> frozenset[int]:
    """Indices of the meshes that are not in a collection; many lights may have the same."""
    if not _says(collection):
        return frozenset()
    query = collection.ComputeMembershipQuery()
    key = frozenset((str(path), str(rule)) for path, rule in query.GetAsPathExpansionRuleMap().items())
    if key not in known:
        known[key] = frozenset(k for k, mesh in enumerate(meshes) if not _includes(query, mesh.name))
    return known[key]


def _includes(query: Any, name: str) -> bool:
    included = query.IsPathIncluded(Sdf.Path(name))
    return bool(included[0] if isinstance(included, tuple) else included)
