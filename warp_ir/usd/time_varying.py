"""Which prims of a stage may vary with time: all others are read once, for any number of times."""

from collections.abc import Collection, Sequence

from pxr import Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel

from warp_ir.usd.shading.binding import PURPOSES, bound_materials, purposes_to_try
from warp_ir.usd.values import read

_ALL = Usd.PrimIsActive & Usd.PrimIsLoaded
"""Predicate that includes `over` and `class`, below which prototypes may be defined."""
_VELOCITY_ATTRIBUTES = ("velocities", "accelerations", "angularVelocities")
"""Attributes that move points or instances away from the time of their sample."""
_TRANSFORM_ATTRIBUTES = ("xformOp:", "visibility")
"""Prefixes of attributes that decide where and whether a prim is drawn, not its geometry."""


class TimeVarying:
    """Tells which prims of a stage may differ in geometry, material or transform between two times.

    Args:
        stage: The stage; it is scanned once.
    """

    def __init__(self, stage: Usd.Stage) -> None:
        self._varying_layout: set[Sdf.Path] = set()
        self._transform_cache: dict[Sdf.Path, bool] = {}
        self._network_cache: dict[Sdf.Path, bool] = {}
        self._has_varying_shaders = False
        self.purposes: Sequence[str] = PURPOSES[:2]
        """Purposes of material bindings, in order of preference."""
        self.layout_varies = False
        """Whether a drawable prim's transform or visibility may vary: each time then needs a new traversal."""
        self._nothing_varies = not any(
            attribute.ValueMightBeTimeVarying() or attribute.GetName() in _VELOCITY_ATTRIBUTES
            for root in (stage.GetPseudoRoot(), *stage.GetPrototypes())
            for prim in Usd.PrimRange(root, _ALL)
            for attribute in prim.GetAuthoredAttributes()
        )
        if self._nothing_varies:
            return
        instancers = []
        for root in (stage.GetPseudoRoot(), *stage.GetPrototypes()):
            for prim in Usd.PrimRange(root, _ALL):
                if prim.IsA(UsdGeom.Imageable):
                    if _transform_or_visibility_varies(prim):
                        self._varying_layout.add(prim.GetPath())
                        self.layout_varies = self.layout_varies or _has_drawables(prim)
                    if prim.IsA(UsdGeom.PointInstancer):
                        instancers.append(prim)
                elif not self._has_varying_shaders and (prim.IsA(UsdShade.Shader) or prim.IsA(UsdShade.NodeGraph)):
                    self._has_varying_shaders = _attributes_vary(prim)
        self._mark_prototypes(instancers)

    def _mark_prototypes(self, instancers: Collection[Usd.Prim]) -> None:
        """Marks the prototypes of varying instancers as varying.

        Prototypes may contain instancers: the marking is repeated until nothing changes.
        """
        unmarked = list(instancers)
        while unmarked:
            varying = [prim for prim in unmarked if self._transform_varies(prim) or _attributes_vary(prim)]
            for prim in varying:
                self.layout_varies = True
                self._varying_layout.update(read.targets(UsdGeom.PointInstancer(prim).GetPrototypesRel()))
            unmarked = [prim for prim in unmarked if prim not in varying] if varying else []
            self._transform_cache.clear()

    def varies(self, prim: Usd.Prim) -> bool:
        """Whether attributes, material, transform or skinning of a gprim, camera or light may vary."""
        return not self._nothing_varies and (
            self._transform_varies(prim)
            or _attributes_vary(prim)
            or self._material_varies(prim)
            or self._is_skinned(prim)
        )

    def deforms(self, prim: Usd.Prim) -> bool:
        """Whether the geometry may vary; transform and material are not considered."""
        return not self._nothing_varies and (_attributes_vary(prim) or self._is_skinned(prim))

    def _transform_varies(self, prim: Usd.Prim) -> bool:
        """Whether transform, visibility or inherited primvars may vary: on the prim itself or on an ancestor."""
        chain = []
        while prim and not prim.IsPseudoRoot() and prim.GetPath() not in self._transform_cache:
            chain.append(prim)
            prim = prim.GetParent()
        result = bool(prim) and not prim.IsPseudoRoot() and self._transform_cache[prim.GetPath()]
        for prim in reversed(chain):
            own = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
            marked = own.GetPath() in self._varying_layout or prim.GetPath() in self._varying_layout
            result = result or marked or _attributes_vary(prim, "primvars:")
            self._transform_cache[prim.GetPath()] = result
        return result

    def _material_varies(self, prim: Usd.Prim) -> bool:
        """Whether a material bound to the prim, or to a GeomSubset of it, may vary."""
        if not self._has_varying_shaders:
            return False
        prims = [prim, *(child for child in prim.GetChildren() if child.IsA(UsdGeom.Subset))]
        bindings = bound_materials(prims, purposes_to_try(self.purposes))
        return any(self._network_varies(pair[0].GetPrim()) for pair in bindings if pair is not None)

    def _network_varies(self, material: Usd.Prim) -> bool:
        """Whether any attribute of the material's shading network may vary; cached."""
        if material.GetPath() not in self._network_cache:
            below = Usd.PrimRange(material, Usd.TraverseInstanceProxies(_ALL))
            self._network_cache[material.GetPath()] = any(_attributes_vary(prim) for prim in below)
        return self._network_cache[material.GetPath()]

    def _is_skinned(self, prim: Usd.Prim) -> bool:
        """Whether a skeleton may deform it: joint transforms are authored on other prims."""
        while prim and not prim.IsPseudoRoot():
            if prim.HasAPI(UsdSkel.BindingAPI) or prim.IsA(UsdSkel.Root):
                return True
            prim = prim.GetParent()
        return False


def _transform_or_visibility_varies(prim: Usd.Prim) -> bool:
    """Whether a prim's transform or visibility, or the choice of its drawn children, may vary."""
    if UsdGeom.Imageable(prim).GetVisibilityAttr().ValueMightBeTimeVarying():
        return True
    schemas = prim.GetAppliedSchemas()
    if ("VisibilityAPI" in schemas or "LODRootAPI" in schemas) and _attributes_vary(prim):
        return True
    try:
        return bool(prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying())
    except Tf.ErrorException:  # the traversal reports the invalid transform
        return False


def _has_drawables(prim: Usd.Prim) -> bool:
    """Whether a prim or a descendant can be drawn or emit light; cameras do not count."""
    return any(
        below.IsA(UsdGeom.Boundable) or below.IsA(UsdLux.NonboundableLightBase) or below.IsInstance()
        for below in Usd.PrimRange(prim, _ALL)
    )


def _attributes_vary(prim: Usd.Prim, prefix: str = "") -> bool:
    """Whether an authored attribute whose name has a prefix may vary; transforms and visibility are not considered.

    Without a prefix, velocities and the attributes of GeomSubsets count as well.
    """
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        if not prefix and name in _VELOCITY_ATTRIBUTES:
            return True
        if (
            name.startswith(prefix)
            and not name.startswith(_TRANSFORM_ATTRIBUTES)
            and attribute.ValueMightBeTimeVarying()
        ):
            return True
    return not prefix and any(_attributes_vary(child) for child in prim.GetChildren() if child.IsA(UsdGeom.Subset))
