"""The walk over a stage: which gprims and lights are drawn, and where; instances included."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLux

from warp_ir.scene import Floats
from warp_ir.usd.geometry.implicit import IMPLICIT
from warp_ir.usd.geometry.instancing import InstanceLevel, read_instancer
from warp_ir.usd.lights.light import LIGHTS
from warp_ir.usd.settings.render_pass import RenderPass
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

_DEPTH = 16
"""Deepest nesting of point instancers that is followed."""
LIGHT_COPIES = 100_000
"""Most copies of one light."""
_FOREIGN = 6
"""How many types of other programs are named."""
_NOTES = ("HoudiniLayerInfo",)
"""Types of other programs that are no part of a scene."""

_IDENTITY = Gf.Matrix4d(1.0)
_WORLD = InstanceLevel(Sdf.Path.absoluteRootPath, None, np.eye(4)[None])
_SHAPES = {"Mesh", "TetMesh", *IMPLICIT}
_DRAWN = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
# A prototype may live below an `over` or a `class`, which keeps it from being drawn where it stands.
_PROTOTYPE = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)


@dataclass(frozen=True, eq=False)
class Site:
    """A prim and the places where it is drawn."""

    prim: Usd.Prim
    level: InstanceLevel
    """The prototype that it is part of; the outermost is the world."""
    local: Floats
    """level_from_prim, float64 [4, 4]."""

    lamp: Usd.Prim | None = None
    """The GeometryLight that makes a gprim emit, if there is one."""

    @property
    def matrices(self) -> Floats:
        """world_from_prim for every place, float64 [k, 4, 4]."""
        return self.level.world_matrices() @ self.local


@dataclass(eq=False)
class Found:
    """What is drawn."""

    shapes: list[Site] = field(default_factory=list)
    lights: list[Site] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Visit:
    """A prim still to be visited, with what it inherits."""

    prim: Usd.Prim
    level: InstanceLevel
    local: Floats
    purpose: object | None
    instancers: tuple[Sdf.Path, ...]


def walk(
    stage: Usd.Stage,
    time: Usd.TimeCode,
    purposes: Collection[str],
    report: Report,
    render_pass: RenderPass | None = None,
) -> Found:
    """Visit every prim once per instancer that draws it, and gather gprims and lights.

    Invisible subtrees, gprims of other purposes and what takes no part in the render pass are counted and left out.
    """
    return _Walk(stage, time, purposes, report, render_pass).run()


class _Walk:
    def __init__(
        self,
        stage: Usd.Stage,
        time: Usd.TimeCode,
        purposes: Collection[str],
        report: Report,
        render_pass: RenderPass | None,
    ) -> None:
        self._stage, self._time, self._purposes, self._report = stage, time, purposes, report
        self._pass = render_pass
        self._transforms = UsdGeom.XformCache(time)
        self._found = Found()
        self._foreign: dict[Sdf.Path, str] = {}
        self._lamps: list[Usd.Prim] = []

    def run(self) -> Found:
        root = _Visit(self._stage.GetPseudoRoot(), _WORLD, np.eye(4), None, ())
        pending = [root]
        while pending:  # a stack of our own: hierarchies may be deeper than Python's
            pending += reversed(self._visit(pending.pop()))
        self._light_geometry()
        self._name_foreign()
        return self._found

    def _visit(self, visit: _Visit) -> list[_Visit]:
        """Gather one prim, and return what is below it."""
        prim, report = visit.prim, self._report
        level, local, purpose = visit.level, visit.local, visit.purpose
        if self._pass is not None and self._pass.prunes(prim):
            report.stats["prims_outside_pass"] += 1
            return []
        name = "default"
        if prim.IsA(UsdGeom.Imageable):
            imageable = UsdGeom.Imageable(prim)
            if read.text(imageable.GetVisibilityAttr(), self._time) == UsdGeom.Tokens.invisible:
                report.stats["prims_invisible"] += 1
                return []
            info = imageable.ComputePurposeInfo(purpose) if purpose else imageable.ComputePurposeInfo()
            name, purpose = info.purpose, info
            level, local = self._placed(prim, level, local)
        if prim.IsInstance():
            report.stats["native_instances"] += 1
            level, local = InstanceLevel(prim.GetPrototype().GetPath(), level, local[None]), np.eye(4)
        kind = prim.GetPrimTypeInfo().GetSchemaTypeName()
        if not kind and prim.GetTypeName() not in ("", *_NOTES):
            self._foreign[prim.GetPath()] = prim.GetTypeName()
        if prim.HasAPI(UsdGeom.ModelAPI):
            mode = read.text(prim.GetAttribute("model:drawMode"), self._time, "inherited")
            if mode not in ("inherited", "default"):
                report.warn(prim.GetPath(), f"draw mode '{mode}' is not honoured: the geometry itself is drawn")
        site = Site(prim, level, local)
        if kind == "PointInstancer":
            if not self._takes_part(prim):
                return []
            return self._instances(visit, level, local, purpose)
        if kind in _SHAPES:
            if self._is_drawn(prim, name):
                self._found.shapes.append(site)
        elif kind in LIGHTS:
            if self._is_drawn(prim, name):
                self._add_light(site)
        elif kind == "GeometryLight":
            if self._is_drawn(prim, name):
                self._lamps.append(prim)
        elif kind == "PortalLight":
            report.warn(prim.GetPath(), "portals are ignored: they would only guide the sampling of a dome")
        elif prim.IsA(UsdGeom.Gprim) or kind == "Volume":
            if self._is_drawn(prim, name):
                report.warn(prim.GetPath(), f"{kind} prims are not rendered ({{n}} in all)")
        elif kind == "RenderPass":
            if self._pass is None:
                report.warn(prim.GetPath(), "no render pass is selected: all is drawn, whatever takes part in this one")
        elif kind in ("LightFilter", "PluginLightFilter"):
            report.warn(prim.GetPath(), "light filters are not read")
        elif prim.HasAPI(UsdLux.LightAPI) or kind == "PluginLight":
            report.warn(prim.GetPath(), f"{kind or prim.GetTypeName()} is not read yet: it emits nothing")
        children = prim.GetFilteredChildren(_PROTOTYPE if visit.instancers else _DRAWN)
        if children and "LODRootAPI" in prim.GetAppliedSchemas():
            # Levels of detail exclude each other; who cannot choose shows the default one.
            default = read.raw(prim.GetAttribute("lod:default:index"), self._time)
            children = children[default if isinstance(default, int) and 0 <= default < len(children) else 0 :][:1]
        return [_Visit(child, level, local, purpose, visit.instancers) for child in children]

    def _placed(self, prim: Usd.Prim, level: InstanceLevel, parent: Floats) -> tuple[InstanceLevel, Floats]:
        """The level of a prim and its place in it, level_from_prim [4, 4], given those of its parent."""
        try:
            local, resets = self._transforms.GetLocalTransformation(prim)
        except Tf.ErrorException:
            self._report.warn(prim.GetPath(), "its transform cannot be read; the identity is used")
            return level, parent
        matrix = np.array(local).T
        if not np.isfinite(matrix).all():
            self._report.warn(prim.GetPath(), "its transform is NaN or infinite; the identity is used")
            return level, parent
        if resets:
            return _WORLD, matrix
        return level, parent if local == _IDENTITY else parent @ matrix

    def _is_drawn(self, prim: Usd.Prim, purpose: str) -> bool:
        """Whether a prim's purpose is wanted, not hidden by VisibilityAPI, and the prim part of the render pass."""
        if purpose not in self._purposes:
            self._report.stats["prims_other_purpose"] += 1
            self._report.stats[f"prims_{purpose}"] += 1
            return False
        if purpose != UsdGeom.Tokens.default_ and self._hides(prim, purpose):
            self._report.stats["prims_invisible"] += 1
            return False
        return self._takes_part(prim)

    def _takes_part(self, prim: Usd.Prim) -> bool:
        """Whether a prim is visible in the render pass, if there is one."""
        if self._pass is None or self._pass.shows(prim):
            return True
        self._report.stats["prims_outside_pass"] += 1
        return False

    def _hides(self, prim: Usd.Prim, purpose: str) -> bool:
        """What the nearest VisibilityAPI says of a purpose; visibility itself, which need not be inherited, apart."""
        while prim and not prim.IsPseudoRoot():
            if prim.HasAPI(UsdGeom.VisibilityAPI):
                attribute = UsdGeom.VisibilityAPI(prim).GetPurposeVisibilityAttr(purpose)
                says = read.text(attribute, self._time) if attribute and attribute.HasAuthoredValue() else ""
                if says in (UsdGeom.Tokens.visible, UsdGeom.Tokens.invisible):
                    return bool(says == UsdGeom.Tokens.invisible)
            prim = prim.GetParent()
        return bool(purpose == UsdGeom.Tokens.guide)

    def _add_light(self, site: Site) -> None:
        if site.level.instance_count > LIGHT_COPIES:
            self._report.warn(
                site.prim.GetPath(), f"{site.level.instance_count} copies of a light: too many, it is left out"
            )
        else:
            self._found.lights.append(site)

    def _name_foreign(self) -> None:
        """Names prims whose types USD does not know, and nobody says what to draw instead (fallbackPrimTypes)."""
        types = list(dict.fromkeys(self._foreign.values()))
        more = f" and {len(types) - _FOREIGN} more" if len(types) > _FOREIGN else ""
        for path in self._foreign:
            self._report.warn(path, f"not rendered, for USD has no such types: {', '.join(types[:_FOREIGN])}{more}")

    def _light_geometry(self) -> None:
        """Gives gprims to the deprecated GeometryLights that refer to them."""
        lamps: dict[Sdf.Path, Usd.Prim] = {}
        for lamp in self._lamps:
            targets = read.targets(lamp.GetRelationship("geometry"))
            lamps.update(dict.fromkeys(targets, lamp))
            if not any(site.prim.GetPath() in targets for site in self._found.shapes):
                self._report.warn(lamp.GetPath(), "its geometry is nothing that is drawn: it emits nothing")
        if lamps:
            shapes = [replace(site, lamp=lamps.get(site.prim.GetPath())) for site in self._found.shapes]
            self._found.shapes = shapes

    def _instances(self, visit: _Visit, level: InstanceLevel, local: Floats, purpose: object | None) -> list[_Visit]:
        """The prototypes of a point instancer, each with all its places."""
        prim, report = visit.prim, self._report
        path = prim.GetPath()
        if len(visit.instancers) >= _DEPTH:
            report.warn(path, f"point instancers nested deeper than {_DEPTH} are not followed")
            return []
        try:
            groups = read_instancer(prim, self._time, report)
        except Unreadable as trouble:
            report.warn(path, f"{trouble}; the instancer is skipped")
            return []
        below: list[_Visit] = []
        for group in groups:
            prototype = self._stage.GetPrimAtPath(group.prototype)
            if not prototype:
                report.warn(path, f"its prototype {group.prototype} does not exist")
                continue
            if any(used.HasPrefix(group.prototype) for used in (*visit.instancers, path)):
                report.warn(
                    path, f"its prototype {group.prototype} holds the instancer itself, or leads back to it; left out"
                )
                continue
            report.stats["point_instances"] += level.instance_count * len(group.matrices)
            key = (prototype.GetPrimInPrototype() if prototype.IsInstanceProxy() else prototype).GetPath()
            inner = InstanceLevel(key, level, local @ group.matrices, group.colors, group.primvars)
            # What lies above a prototype gives it no place and hides it not, but a purpose.
            own = UsdGeom.Imageable(prototype).ComputePurposeInfo() if prototype.IsA(UsdGeom.Imageable) else None
            inherited = own if own is not None and own.isInheritable else purpose
            below.append(_Visit(prototype, inner, np.eye(4), inherited, (*visit.instancers, path)))
        return below
