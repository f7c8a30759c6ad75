"""Light links and shadow links: which meshes a light lights, and which cast its shadows."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

from pxr import Sdf, Usd, UsdGeom, UsdLux

from warp_ir.scene import Light, Mesh, MeshLight
from warp_ir.usd.settings.render_pass import includes
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report


class Linking:
    """The links of a stage's lights that leave something out.

    Args:
        lights: The prims of all lights, gprims that are lights among them.
    """

    def __init__(self, lights: Iterable[Usd.Prim]) -> None:
        self._queries: dict[_Rules, Any] = {}
        for prim in lights:
            api = UsdLux.LightAPI(prim)
            for collection in (api.GetLightLinkCollectionAPI(), api.GetShadowLinkCollectionAPI()):
                if _says(collection):
                    query = collection.ComputeMembershipQuery()
                    self._queries.setdefault(_rules(collection, query), query)

    @property
    def rules(self) -> frozenset[object]:
        """Equal for the same links."""
        return frozenset(self._queries)

    def of(self, path: Sdf.Path) -> tuple[bool, ...]:
        """Which of them hold a gprim; its copies can be stored once where that is the same for all."""
        return tuple(includes(query, path) for query in self._queries.values())


_Rules = tuple[frozenset[tuple[str, str]], str]
_Links = tuple[frozenset[int], frozenset[int]]
"""Unlit and shadowless meshes."""

_EVERYTHING = {Sdf.Path.absoluteRootPath: Usd.Tokens.expandPrims}
"""What a collection is that has all prims."""

# A mesh that does not move is the same object at all times, linked or not.
_LINKED: WeakKeyDictionary[Mesh, Mesh] = WeakKeyDictionary()


def link(
    stage: Usd.Stage, lights: Sequence[Light], meshes: Sequence[Mesh], report: Report
) -> tuple[tuple[Light, ...], tuple[Mesh, ...]]:
    """The lights, and the meshes that are lights, with their links to the meshes of a scene, all named by their paths.

    Args:
        stage: Where the lights are.
        lights: Of the scene.
        meshes: Of the scene, in its order.
        report: Where links to parts of meshes go: they are not followed.
    """
    known: dict[Any, frozenset[int]] = {}

    def links(light: Light | MeshLight) -> _Links:
        prim = stage.GetPrimAtPath(light.name) if Sdf.Path.IsValidPathString(light.name) else None
        if not prim:
            return frozenset(), frozenset()
        api = UsdLux.LightAPI(prim)
        collections = api.GetLightLinkCollectionAPI(), api.GetShadowLinkCollectionAPI()
        if any(_names_subsets(stage, collection) for collection in collections if _says(collection)):
            report.warn(light.name, "its links to face subsets are ignored: those of the whole mesh count")
        unlit, shadowless = (_outside(collection, meshes, known) for collection in collections)
        return unlit, shadowless

    linked = []
    for light in lights:
        unlit, shadowless = links(light)
        linked.append(replace(light, unlit=unlit, shadowless=shadowless) if unlit or shadowless else light)
    return tuple(linked), tuple(mesh if mesh.light is None else _with_links(mesh, links(mesh.light)) for mesh in meshes)


def _with_links(mesh: Mesh, links: _Links) -> Mesh:
    """The mesh with the links of its light; the same object for the same."""
    assert mesh.light is not None
    if links == (mesh.light.unlit, mesh.light.shadowless):
        return mesh
    known = _LINKED.get(mesh)
    if known is None or known.light is None or links != (known.light.unlit, known.light.shadowless):
        known = replace(mesh, light=replace(mesh.light, unlit=links[0], shadowless=links[1]))
        _LINKED[mesh] = known
    return known


def _says(collection: Usd.CollectionAPI) -> bool:
    """Whether a file says anything of a collection; if not, it has everything."""
    return bool(collection.GetPrim().GetAuthoredPropertiesInNamespace(f"collection:{collection.GetName()}"))


def _names_subsets(stage: Usd.Stage, collection: Usd.CollectionAPI) -> bool:
    """Whether a collection tells parts of a mesh apart."""
    targets = (*read.targets(collection.GetIncludesRel()), *read.targets(collection.GetExcludesRel()))
    return any(prim.IsA(UsdGeom.Subset) for path in targets if (prim := stage.GetPrimAtPath(path.GetPrimPath())))


def _outside(collection: Usd.CollectionAPI, meshes: Sequence[Mesh], known: dict[Any, frozenset[int]]) -> frozenset[int]:
    """Indices of the meshes that are not in a collection; many lights may have the same."""
    if not _says(collection):
        return frozenset()
    query = collection.ComputeMembershipQuery()
    if query.GetAsPathExpansionRuleMap() == _EVERYTHING:
        return frozenset()
    key = _rules(collection, query)
    if key not in known:
        known[key] = frozenset(k for k, mesh in enumerate(meshes) if not includes(query, Sdf.Path(mesh.name)))
    return known[key]


def _rules(collection: Usd.CollectionAPI, query: Any) -> _Rules:
    """Equal for collections of the same members."""
    rules = frozenset((str(path), str(rule)) for path, rule in query.GetAsPathExpansionRuleMap().items())
    return rules, "" if query.UsesPathExpansionRuleMap() else str(collection.ResolveCompleteMembershipExpression())
