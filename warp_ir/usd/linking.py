"""Light linking: which meshes a light illuminates (lightLink), and which cast its shadows (shadowLink)."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

from pxr import Sdf, Usd, UsdGeom, UsdLux

from warp_ir.scene import Light, Mesh, MeshLight
from warp_ir.usd.settings.render_pass import includes
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report


class LightLinks:
    """The light and shadow links of a stage that exclude something.

    Args:
        lights: The prims of all lights, gprims that are lights included.
    """

    def __init__(self, lights: Iterable[Usd.Prim]) -> None:
        self._queries: dict[_RulesKey, Usd.UsdCollectionMembershipQuery] = {}
        for prim in lights:
            api = UsdLux.LightAPI(prim)
            for collection in (api.GetLightLinkCollectionAPI(), api.GetShadowLinkCollectionAPI()):
                if _is_authored(collection):
                    query = collection.ComputeMembershipQuery()
                    self._queries.setdefault(_rules_key(collection, query), query)

    @property
    def key(self) -> frozenset[object]:
        """Equal for equal links."""
        return frozenset(self._queries)

    def memberships(self, path: Sdf.Path) -> tuple[bool, ...]:
        """Whether each link contains a gprim; instances can share a mesh only if these are equal."""
        return tuple(includes(query, path) for query in self._queries.values())


_RulesKey = tuple[frozenset[tuple[str, str]], str]
_ExcludedMeshes = tuple[frozenset[int], frozenset[int]]
"""Indices of unlit and of shadowless meshes."""

_ALL_PRIMS = {Sdf.Path.absoluteRootPath: Usd.Tokens.expandPrims}
"""Rules of a collection that contains all prims."""

# A static mesh must be the same object at all times, with links or without.
_MESHES_WITH_LINKS: WeakKeyDictionary[Mesh, Mesh] = WeakKeyDictionary()


def link_lights(
    stage: Usd.Stage, lights: Sequence[Light], meshes: Sequence[Mesh], report: Report
) -> tuple[tuple[Light, ...], tuple[Mesh, ...]]:
    """The lights, and the meshes that are lights, with indices of the meshes that their links exclude.

    Lights and meshes are matched to prims by their names, which are paths.

    Args:
        stage: The stage.
        lights: The scene's lights.
        meshes: The scene's meshes, in order.
        report: Receives warnings of links to GeomSubsets, which are not supported.
    """
    cache: dict[_RulesKey, frozenset[int]] = {}

    def links(light: Light | MeshLight) -> _ExcludedMeshes:
        prim = stage.GetPrimAtPath(light.name) if Sdf.Path.IsValidPathString(light.name) else None
        if not prim:
            return frozenset(), frozenset()
        api = UsdLux.LightAPI(prim)
        collections = api.GetLightLinkCollectionAPI(), api.GetShadowLinkCollectionAPI()
        if any(_targets_subsets(stage, collection) for collection in collections if _is_authored(collection)):
            report.warn(light.name, "its links to GeomSubsets are ignored: those to whole meshes are used")
        unlit, shadowless = (_excluded_meshes(collection, meshes, cache) for collection in collections)
        return unlit, shadowless

    linked_lights = []
    for light in lights:
        unlit, shadowless = links(light)
        linked_lights.append(replace(light, unlit=unlit, shadowless=shadowless) if unlit or shadowless else light)
    return tuple(linked_lights), tuple(
        mesh if mesh.light is None else _with_links(mesh, links(mesh.light)) for mesh in meshes
    )


def _with_links(mesh: Mesh, links: _ExcludedMeshes) -> Mesh:
    """The mesh with the links of its light; the same object for equal arguments."""
    assert mesh.light is not None
    if links == (mesh.light.unlit, mesh.light.shadowless):
        return mesh
    cache = _MESHES_WITH_LINKS.get(mesh)
    if cache is None or cache.light is None or links != (cache.light.unlit, cache.light.shadowless):
        cache = replace(mesh, light=replace(mesh.light, unlit=links[0], shadowless=links[1]))
        _MESHES_WITH_LINKS[mesh] = cache
    return cache


def _is_authored(collection: Usd.CollectionAPI) -> bool:
    """Whether a collection is authored; if not, it contains everything."""
    return bool(collection.GetPrim().GetAuthoredPropertiesInNamespace(f"collection:{collection.GetName()}"))


def _targets_subsets(stage: Usd.Stage, collection: Usd.CollectionAPI) -> bool:
    """Whether a collection targets GeomSubsets."""
    targets = (*read.targets(collection.GetIncludesRel()), *read.targets(collection.GetExcludesRel()))
    return any(prim.IsA(UsdGeom.Subset) for path in targets if (prim := stage.GetPrimAtPath(path.GetPrimPath())))


def _excluded_meshes(
    collection: Usd.CollectionAPI, meshes: Sequence[Mesh], cache: dict[_RulesKey, frozenset[int]]
) -> frozenset[int]:
    """Indices of the meshes that a collection does not contain, cached: many lights may have equal links."""
    if not _is_authored(collection):
        return frozenset()
    query = collection.ComputeMembershipQuery()
    if query.GetAsPathExpansionRuleMap() == _ALL_PRIMS:
        return frozenset()
    key = _rules_key(collection, query)
    if key not in cache:
        cache[key] = frozenset(k for k, mesh in enumerate(meshes) if not includes(query, Sdf.Path(mesh.name)))
    return cache[key]


def _rules_key(collection: Usd.CollectionAPI, query: Usd.UsdCollectionMembershipQuery) -> _RulesKey:
    """Equal for collections with equal members."""
    key = frozenset((str(path), str(rule)) for path, rule in query.GetAsPathExpansionRuleMap().items())
    return key, "" if query.UsesPathExpansionRuleMap() else str(collection.ResolveCompleteMembershipExpression())
