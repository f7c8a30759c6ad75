"""What of a stage may change with time: the rest is read once, however many moments are asked for."""

from collections.abc import Collection, Sequence

from pxr import Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel

from warp_ir.usd.shading.binding import PURPOSES, bound_materials, order_of
from warp_ir.usd.values import read

_ALL = Usd.PrimIsActive & Usd.PrimIsLoaded
"""Prototypes may live below an `over` or a `class`."""
_CARRYING = ("velocities", "accelerations", "angularVelocities")
"""Attributes that move what they belong to away from the time of their sample."""
_PLACING = ("xformOp:", "visibility")
"""Attributes that say where and whether a prim is drawn, not what it is."""


class Motion:
    """Which prims of a stage may look different, or be elsewhere, at another time."""

    def __init__(self, stage: Usd.Stage) -> None:
        self._moving: set[Sdf.Path] = set()
        self._known: dict[Sdf.Path, bool] = {}
        self._networks: dict[Sdf.Path, bool] = {}
        self._shading = False
        self.purposes: Sequence[str] = PURPOSES[:2]
        """Of the bindings of materials that count."""
        self.rearranges = False
        """Whether anything that can be drawn may move, appear or vanish."""
        instancers = []
        for root in (stage.GetPseudoRoot(), *stage.GetPrototypes()):
            for prim in Usd.PrimRange(root, _ALL):
                if prim.IsA(UsdGeom.Imageable):
                    if _is_rearranged(prim):
                        self._moving.add(prim.GetPath())
                        self.rearranges = self.rearranges or _holds_what_is_drawn(prim)
                    if prim.IsA(UsdGeom.PointInstancer):
                        instancers.append(prim)
                elif not self._shading and (prim.IsA(UsdShade.Shader) or prim.IsA(UsdShade.NodeGraph)):
                    self._shading = _varies(prim)
        self._follow(instancers)

    def _follow(self, instancers: Collection[Usd.Prim]) -> None:
        """The prototypes of an instancer that moves move as well; they may hold instancers."""
        waiting = list(instancers)
        while waiting:
            moving = [prim for prim in waiting if self._placed(prim) or _varies(prim)]
            for prim in moving:
                self.rearranges = True
                self._moving.update(read.targets(UsdGeom.PointInstancer(prim).GetPrototypesRel()))
            waiting = [prim for prim in waiting if prim not in moving] if moving else []
            self._known.clear()

    def moves(self, prim: Usd.Prim) -> bool:
        """Whether a gprim, camera or light may be elsewhere, or another, at another time."""
        return self._placed(prim) or _varies(prim) or self._looks(prim) or self._is_skinned(prim)

    def reshapes(self, prim: Usd.Prim) -> bool:
        """Whether its geometry may be another, its place and its looks apart."""
        return _varies(prim) or self._is_skinned(prim)

    def _placed(self, prim: Usd.Prim) -> bool:
        """Whether the prim or what is above it may move, vanish, or change the primvars that it hands down."""
        chain = []
        while prim and not prim.IsPseudoRoot() and prim.GetPath() not in self._known:
            chain.append(prim)
            prim = prim.GetParent()
        moves = bool(prim) and not prim.IsPseudoRoot() and self._known[prim.GetPath()]
        for prim in reversed(chain):
            own = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
            here = own.GetPath() in self._moving or prim.GetPath() in self._moving
            moves = moves or here or _varies(prim, "primvars:")
            self._known[prim.GetPath()] = moves
        return moves

    def _looks(self, prim: Usd.Prim) -> bool:
        """Whether a material bound to the prim, or to a part of it, may change."""
        if not self._shading:
            return False
        prims = [prim, *(child for child in prim.GetChildren() if child.IsA(UsdGeom.Subset))]
        found = bound_materials(prims, order_of(self.purposes))
        return any(self._network(pair[0].GetPrim()) for pair in found if pair is not None)

    def _network(self, material: Usd.Prim) -> bool:
        if material.GetPath() not in self._networks:
            below = Usd.PrimRange(material, Usd.TraverseInstanceProxies(_ALL))
            self._networks[material.GetPath()] = any(_varies(prim) for prim in below)
        return self._networks[material.GetPath()]

    def _is_skinned(self, prim: Usd.Prim) -> bool:
        """Whether a skeleton may bend it: what moves the joints is written elsewhere."""
        while prim and not prim.IsPseudoRoot():
            if prim.HasAPI(UsdSkel.BindingAPI) or prim.IsA(UsdSkel.Root):
                return True
            prim = prim.GetParent()
        return False


def _is_rearranged(prim: Usd.Prim) -> bool:
    """Whether a prim may move, or another part of what is below it be shown."""
    if UsdGeom.Imageable(prim).GetVisibilityAttr().ValueMightBeTimeVarying():
        return True
    schemas = prim.GetAppliedSchemas()
    if ("VisibilityAPI" in schemas or "LODRootAPI" in schemas) and _varies(prim):
        return True
    try:
        return bool(prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying())
    except Tf.ErrorException:  # the walk names what is wrong with it
        return False


def _holds_what_is_drawn(prim: Usd.Prim) -> bool:
    """Whether there is more than cameras below a prim."""
    return any(
        below.IsA(UsdGeom.Boundable) or below.IsA(UsdLux.NonboundableLightBase) or below.IsInstance()
        for below in Usd.PrimRange(prim, _ALL)
    )


def _varies(prim: Usd.Prim, prefix: str = "") -> bool:
    """Whether an attribute of the prim, or of a subset of its faces, may change; where it is apart."""
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        if not prefix and name in _CARRYING:
            return True
        if name.startswith(prefix) and not name.startswith(_PLACING) and attribute.ValueMightBeTimeVarying():
            return True
    return not prefix and any(_varies(child) for child in prim.GetChildren() if child.IsA(UsdGeom.Subset))
