"""Traversal of a stage: which gprims and lights are drawn, and with which transforms, instances included."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLux

from warp_ir.scene import Floats
from warp_ir.usd.geometry.curves import CURVES
from warp_ir.usd.geometry.draw_mode import DrawMode, draw_mode, read_draw_mode
from warp_ir.usd.geometry.implicit import IMPLICIT
from warp_ir.usd.geometry.instancing import InstanceLevel, read_instancer
from warp_ir.usd.lights.light import LIGHTS
from warp_ir.usd.settings.render_pass import RenderPass
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

_MAX_INSTANCER_DEPTH = 16
"""Maximum nesting depth of point instancers."""
MAX_LIGHT_COPIES = 100_000
"""Maximum number of instances of one light."""
_MAX_NAMED_TYPES = 6
"""Maximum number of unknown prim types that one warning lists."""
_METADATA_TYPES = ("HoudiniLayerInfo",)
"""Unknown prim types that hold metadata only: they are not reported."""

_IDENTITY = Gf.Matrix4d(1.0)
_WORLD = InstanceLevel(Sdf.Path.absoluteRootPath, None, np.eye(4)[None])
_GPRIM_TYPES = {"Mesh", "TetMesh", *IMPLICIT, *CURVES, "NurbsPatch", "Points"}
_DRAWN_PREDICATE = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
# A prototype may be defined below an `over` or a `class`, which are not drawn themselves.
_PROTOTYPE_PREDICATE = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)


@dataclass(frozen=True, eq=False)
class DrawnPrim:
    """A prim that is drawn, with the transforms of all its instances."""

    prim: Usd.Prim
    level: InstanceLevel
    """The instancing level that contains the prim; the outermost level is the world."""
    level_from_prim: Floats
    """Transform from the prim to its level, float64 [4, 4]."""
    authored: frozenset[str]
    """Names of the properties that the prim has opinions on; only these are read."""
    has_children: bool = True
    """Whether it has children, GeomSubsets among them."""
    geometry_light: Usd.Prim | None = None
    """The GeometryLight whose `geometry` relationship targets this gprim; None: there is none."""
    draw_mode: DrawMode | None = None
    """What stands in for the geometry of a model; None: the prim is a gprim."""

    @property
    def matrices(self) -> Floats:
        """world_from_prim of every instance, float64 [k, 4, 4]."""
        return self.level.world_matrices() @ self.level_from_prim

    def as_instance(self) -> "DrawnPrim":
        """The same prim as the only instance in a level of its own, which may be stored as a prototype."""
        path = (self.prim.GetPrimInPrototype() if self.prim.IsInstanceProxy() else self.prim).GetPath()
        level = InstanceLevel(path, self.level, self.level_from_prim[None])
        return replace(self, level=level, level_from_prim=np.eye(4))


@dataclass(eq=False)
class DrawnPrims:
    """The gprims and lights that are drawn."""

    gprims: list[DrawnPrim] = field(default_factory=list)
    lights: list[DrawnPrim] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _PendingPrim:
    """A prim on the stack of the traversal, with the state it inherits."""

    prim: Usd.Prim
    level: InstanceLevel
    level_from_prim: Floats
    purpose: UsdGeom.Imageable.PurposeInfo | None
    instancers: tuple[Sdf.Path, ...]
    origin: "_Origin"


@dataclass(frozen=True, eq=False)
class _Origin:
    """What a prim that resets its transform stack is a child of: the world, or an instance of a point instancer."""

    level: InstanceLevel
    prototype: Usd.Prim | None = None
    """The prototype of the innermost point instancer around the prim; None: the prim is in none."""


def traverse_stage(
    stage: Usd.Stage,
    time: Usd.TimeCode,
    purposes: Collection[str],
    report: Report,
    render_pass: RenderPass | None = None,
) -> DrawnPrims:
    """Visit every prim once per instancer that draws it, and collect gprims and lights.

    Invisible subtrees, gprims of other purposes and prims outside the render pass are counted and skipped.

    Args:
        stage: The stage; its pseudo-root is the start.
        time: Time code of all values.
        purposes: The purposes to draw.
        report: Receives warnings and counts.
        render_pass: The render pass that filters prims; None: all take part.
    """
    return _Traversal(stage, time, purposes, report, render_pass).run()


class _Traversal:
    """State of one traversal; see `traverse_stage`."""

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
        self._drawn = DrawnPrims()
        self._unknown_types: dict[Sdf.Path, str] = {}
        self._geometry_lights: list[Usd.Prim] = []
        self._has_draw_modes = False
        self._imageable: dict[str, bool] = {}

    def run(self) -> DrawnPrims:
        """Traverses the stage from its pseudo-root."""
        root = _PendingPrim(self._stage.GetPseudoRoot(), _WORLD, np.eye(4), None, (), _Origin(_WORLD))
        stack = [root]
        while stack:  # an explicit stack: hierarchies may be deeper than Python's recursion limit
            stack += reversed(self._visit(stack.pop()))
        self._attach_geometry_lights()
        self._report_unknown_types()
        return self._drawn

    def _visit(self, pending: _PendingPrim) -> list[_PendingPrim]:
        """Collect one prim; returns its children."""
        prim, report = pending.prim, self._report
        level, level_from_prim, purpose = pending.level, pending.level_from_prim, pending.purpose
        if self._pass is not None and self._pass.prunes(prim):
            report.stats["prims_outside_pass"] += 1
            return []
        own_purpose = "default"
        authored = frozenset(prim.GetAuthoredPropertyNames())  # one call instead of one for each that is not authored
        schema = prim.GetPrimTypeInfo().GetSchemaTypeName()
        if schema not in self._imageable:
            self._imageable[schema] = prim.IsA(UsdGeom.Imageable)
        if self._imageable[schema]:
            if "visibility" in authored:
                if read.text(prim.GetAttribute("visibility"), self._time) == UsdGeom.Tokens.invisible:
                    report.stats["prims_invisible"] += 1
                    return []
            if "purpose" in authored or purpose is None:  # else that of the parent, be it inheritable or the fallback
                imageable = UsdGeom.Imageable(prim)
                purpose = imageable.ComputePurposeInfo(purpose) if purpose else imageable.ComputePurposeInfo()
            own_purpose = purpose.purpose
            if "xformOpOrder" in authored:
                level, level_from_prim = self._transformed(prim, level, level_from_prim, pending.origin)
        if "model:drawMode" in authored:
            self._has_draw_modes = True
        if self._has_draw_modes and (mode := draw_mode(prim)):
            try:
                stand_in = read_draw_mode(prim, mode, self._time)
            except Unreadable as trouble:
                report.warn(prim.GetPath(), f"draw mode '{mode}': {trouble}; the geometry itself is drawn")
            else:
                report.stats["draw_modes"] += 1
                if self._is_drawn(prim, own_purpose):
                    self._drawn.gprims.append(DrawnPrim(prim, level, level_from_prim, authored, draw_mode=stand_in))
                return []
        if prim.IsInstance():
            report.stats["native_instances"] += 1
            level, level_from_prim = (
                InstanceLevel(prim.GetPrototype().GetPath(), level, level_from_prim[None]),
                np.eye(4),
            )
        if not schema and prim.GetTypeName() not in ("", *_METADATA_TYPES):
            self._unknown_types[prim.GetPath()] = prim.GetTypeName()
        children = prim.GetFilteredChildren(_PROTOTYPE_PREDICATE if pending.instancers else _DRAWN_PREDICATE)
        drawn = DrawnPrim(prim, level, level_from_prim, authored, bool(children))
        if schema == "PointInstancer":
            if not self._in_render_pass(prim):
                return []
            return self._prototypes_of(pending, level, level_from_prim, purpose)
        if schema in _GPRIM_TYPES:
            if self._is_drawn(prim, own_purpose):
                self._drawn.gprims.append(drawn)
        elif schema in LIGHTS:
            if self._is_drawn(prim, own_purpose):
                self._add_light(drawn)
        elif schema == "GeometryLight":
            if self._is_drawn(prim, own_purpose):
                self._geometry_lights.append(prim)
        elif schema == "PortalLight":
            report.warn(prim.GetPath(), "portals are ignored: they would only guide the sampling of a dome")
        elif prim.IsA(UsdGeom.Gprim) or schema == "Volume":
            if self._is_drawn(prim, own_purpose):
                report.warn(prim.GetPath(), f"{schema} prims are not rendered ({{n}} in all)")
        elif schema == "RenderPass":
            if self._pass is None:
                report.warn(prim.GetPath(), "no render pass is selected: prims outside this one are drawn as well")
        elif schema in ("LightFilter", "PluginLightFilter"):
            name = read.text(prim.GetAttribute("lightFilter:shaderId"), self._time) or schema
            report.warn(prim.GetPath(), f"light filters are not supported: {name} changes nothing")
        elif prim.HasAPI(UsdLux.LightAPI) or schema == "PluginLight":
            report.warn(prim.GetPath(), f"{schema or prim.GetTypeName()} is not supported: it emits nothing")
        if children and "LODRootAPI" in prim.GetAppliedSchemas():
            # LODRootAPI: children are alternatives; a renderer without heuristics draws lod:default:index.
            default_index = read.raw(prim.GetAttribute("lod:default:index"), self._time)
            valid = isinstance(default_index, int) and 0 <= default_index < len(children)
            children = children[default_index if valid else 0 :][:1]
        inherited = purpose, pending.instancers, pending.origin
        return [_PendingPrim(child, level, level_from_prim, *inherited) for child in children]

    def _transformed(
        self, prim: Usd.Prim, level: InstanceLevel, parent: Floats, origin: _Origin
    ) -> tuple[InstanceLevel, Floats]:
        """The level of a prim and its transform level_from_prim [4, 4], given those of its parent.

        `!resetXformStack!` makes the prim a child of `origin`.
        """
        try:
            transform, resets = self._transforms.GetLocalTransformation(prim)
        except Tf.ErrorException:
            self._report.warn(prim.GetPath(), "its transform cannot be read; the identity is used")
            return level, parent
        if transform == _IDENTITY and not resets:
            return level, parent
        matrix = np.array(transform).T
        if not (math.isfinite(matrix.sum()) or np.isfinite(matrix).all()):
            self._report.warn(prim.GetPath(), "its transform is NaN or infinite; the identity is used")
            return level, parent
        if resets:
            return origin.level, self._level_from_world(origin.prototype, prim) @ matrix
        return level, parent @ matrix

    def _level_from_world(self, prototype: Usd.Prim | None, prim: Usd.Prim) -> Floats:
        """The transform [4, 4] from the world to the instances of a prototype, for a prim that resets its stack.

        As in `UsdGeom.BBoxCache`, instances move prims relative to the prototype's parent in the stage; they ignore
        that parent if the prototype resets its stack itself.
        """
        if prototype is None or prototype == prim:
            return np.eye(4)
        try:
            if self._transforms.GetLocalTransformation(prototype)[1]:
                return np.eye(4)
            world_from_parent = np.array(self._transforms.GetParentToWorldTransform(prototype)).T
            parent_from_world: Floats = np.linalg.inv(world_from_parent)
            if np.isfinite(parent_from_world).all():
                return parent_from_world
        except (Tf.ErrorException, np.linalg.LinAlgError):
            pass
        what = f"it resets its transform stack, but that of {prototype.GetParent().GetPath()} cannot be inverted"
        self._report.warn(prim.GetPath(), f"{what}: it is placed in the instances as in the world")
        return np.eye(4)

    def _is_drawn(self, prim: Usd.Prim, purpose: str) -> bool:
        """Whether the purpose is included, VisibilityAPI does not hide it, and the render pass contains the prim."""
        if purpose not in self._purposes:
            self._report.stats["prims_other_purpose"] += 1
            self._report.stats[f"prims_{purpose}"] += 1
            return False
        if purpose != UsdGeom.Tokens.default_ and self._hidden_by_purpose(prim, purpose):
            self._report.stats["prims_invisible"] += 1
            return False
        return self._in_render_pass(prim)

    def _in_render_pass(self, prim: Usd.Prim) -> bool:
        """Whether the render pass, if there is one, contains the prim."""
        if self._pass is None or self._pass.shows(prim):
            return True
        self._report.stats["prims_outside_pass"] += 1
        return False

    def _hidden_by_purpose(self, prim: Usd.Prim, purpose: str) -> bool:
        """Whether the nearest VisibilityAPI hides a purpose; the traversal itself tests the attribute `visibility`."""
        while prim and not prim.IsPseudoRoot():
            if prim.HasAPI(UsdGeom.VisibilityAPI):
                attribute = UsdGeom.VisibilityAPI(prim).GetPurposeVisibilityAttr(purpose)
                visibility = read.text(attribute, self._time) if attribute and attribute.HasAuthoredValue() else ""
                if visibility in (UsdGeom.Tokens.visible, UsdGeom.Tokens.invisible):
                    return bool(visibility == UsdGeom.Tokens.invisible)
            prim = prim.GetParent()
        return bool(purpose == UsdGeom.Tokens.guide)

    def _add_light(self, drawn: DrawnPrim) -> None:
        if drawn.level.instance_count > MAX_LIGHT_COPIES:
            copies = drawn.level.instance_count
            what = f"{copies} instances of a light exceed the limit of {MAX_LIGHT_COPIES}: it is skipped"
            self._report.warn(drawn.prim.GetPath(), what)
        else:
            self._drawn.lights.append(drawn)

    def _report_unknown_types(self) -> None:
        """Warns of prims of unknown types without fallbackPrimTypes; their children are drawn."""
        types = list(dict.fromkeys(self._unknown_types.values()))
        listed = ", ".join(types[:_MAX_NAMED_TYPES])
        unlisted = f" and {len(types) - _MAX_NAMED_TYPES} more" if len(types) > _MAX_NAMED_TYPES else ""
        for path in self._unknown_types:
            self._report.warn(path, f"not rendered: prim types unknown to USD: {listed}{unlisted}")

    def _attach_geometry_lights(self) -> None:
        """Assigns deprecated GeometryLights to the gprims that they target."""
        light_by_target: dict[Sdf.Path, Usd.Prim] = {}
        for geometry_light in self._geometry_lights:
            targets = read.targets(geometry_light.GetRelationship("geometry"))
            light_by_target.update(dict.fromkeys(targets, geometry_light))
            if not any(drawn.prim.GetPath() in targets for drawn in self._drawn.gprims):
                self._report.warn(geometry_light.GetPath(), "none of its geometry is drawn: it emits nothing")
        if light_by_target:
            self._drawn.gprims = [
                replace(drawn, geometry_light=light_by_target.get(drawn.prim.GetPath())) for drawn in self._drawn.gprims
            ]

    def _prototypes_of(
        self,
        pending: _PendingPrim,
        level: InstanceLevel,
        level_from_prim: Floats,
        purpose: UsdGeom.Imageable.PurposeInfo | None,
    ) -> list[_PendingPrim]:
        """The prototypes of a point instancer, each with the transforms of all its instances."""
        prim, report = pending.prim, self._report
        path = prim.GetPath()
        if len(pending.instancers) >= _MAX_INSTANCER_DEPTH:
            report.warn(path, f"point instancers nested deeper than {_MAX_INSTANCER_DEPTH} are not followed")
            return []
        try:
            groups = read_instancer(prim, self._time, report)
        except Unreadable as trouble:
            report.warn(path, f"{trouble}; the instancer is skipped")
            return []
        children: list[_PendingPrim] = []
        for group in groups:
            prototype = self._stage.GetPrimAtPath(group.prototype)
            if not prototype:
                report.warn(path, f"its prototype {group.prototype} does not exist")
                continue
            if any(used.HasPrefix(group.prototype) for used in (*pending.instancers, path)):
                report.warn(path, f"its prototype {group.prototype} contains the instancer itself; it is skipped")
                continue
            report.stats["point_instances"] += level.instance_count * len(group.matrices)
            key = (prototype.GetPrimInPrototype() if prototype.IsInstanceProxy() else prototype).GetPath()
            inner = InstanceLevel(key, level, level_from_prim @ group.matrices, group.colors, group.primvars)
            # Ancestors of a prototype contribute neither transform nor visibility, only an inheritable purpose.
            own = UsdGeom.Imageable(prototype).ComputePurposeInfo() if prototype.IsA(UsdGeom.Imageable) else None
            inherited = own if own is not None and own.isInheritable else purpose
            instancers, origin = (*pending.instancers, path), _Origin(inner, prototype)
            children.append(_PendingPrim(prototype, inner, np.eye(4), inherited, instancers, origin))
        return children
