"""The inputs of a light."""

from pxr import Sdf, Usd, UsdGeom, UsdShade

from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report


class Inputs:
    """A light's inputs; files from before USD 21.02 have them without the prefix ``inputs:``.

    Args:
        prim: With LightAPI.
        time: Of the values.
        report: Where troubles go.
    """

    def __init__(self, prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> None:
        self.prim, self.time, self._report = prim, time, report
        # On a gprim `radius` and the like are geometry.
        self._may_be_old = not prim.IsA(UsdGeom.Gprim)

    def attribute(self, name: str) -> Usd.Attribute:
        """The attribute that holds an input; where it is connected to an interface, the one that it leads to."""
        current = self.prim.GetAttribute(f"inputs:{name}")
        old = self.prim.GetAttribute(name)
        if self._may_be_old and old and old.HasAuthoredValue() and not (current and current.HasAuthoredValue()):
            self.warn("inputs authored in the old style, without 'inputs:', are used")
            return old
        if current and current.HasAuthoredConnections():
            return self._source(current)
        return current

    def _source(self, connected: Usd.Attribute) -> Usd.Attribute:
        """What gives an input its value, unless that is a shader."""
        found = UsdShade.Utils.GetValueProducingAttributes(UsdShade.Input(connected))
        if len(found) == 1 and UsdShade.Input.IsInput(found[0]):
            return found[0]
        self.warn(f"{connected.GetName()}: the shader that it is connected to is not read; its own value counts")
        return connected

    def authored(self, *names: str) -> bool:
        """Whether a file gives a value to any of these inputs."""
        attributes = (self.attribute(name) for name in names)
        return any(attribute and attribute.HasAuthoredValue() for attribute in attributes)

    def applied(self, schema: type[Usd.APISchemaBase], *names: str) -> bool:
        """Whether a schema is applied to the prim. Where it is not, its inputs `names` do not count, and are named."""
        applied = bool(self.prim.HasAPI(schema))
        idle = [] if applied else [name for name in names if self.authored(name)]
        if idle:
            self.warn(f"{', '.join(idle)}: ignored, since {schema.__name__} is not applied to the prim")
        return applied

    def number(self, name: str, default: float) -> float:
        """A number input."""
        return read.number(self.attribute(name), self.time, default)

    def flag(self, name: str, default: bool = False) -> bool:
        """A truth value; False by default, as almost everywhere in UsdLux."""
        return read.flag(self.attribute(name), self.time, default)

    def text(self, name: str, default: str = "") -> str:
        """A token."""
        return read.text(self.attribute(name), self.time, default)

    def asset(self, name: str) -> Sdf.AssetPath | None:
        """A file, if one is named."""
        path = read.raw(self.attribute(name), self.time)
        return path if isinstance(path, Sdf.AssetPath) and path.path != "" else None

    def warn(self, what: str) -> None:
        """Say something about the light."""
        self._report.warn(self.prim.GetPath(), what)
