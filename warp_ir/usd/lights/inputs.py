"""Reads the inputs of a light prim."""

from pxr import Sdf, Usd, UsdGeom, UsdShade

from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report


class LightInputs:
    """Reads a light's inputs; files written before USD 21.02 name them without the prefix ``inputs:``.

    Args:
        prim: A prim with LightAPI.
        time: Time code of all values.
        report: Receives warnings.
    """

    def __init__(self, prim: Usd.Prim, time: Usd.TimeCode, report: Report) -> None:
        self.prim, self.time, self._report = prim, time, report
        # Un-prefixed attributes of a gprim, such as `radius`, are geometry.
        self._may_be_legacy = not prim.IsA(UsdGeom.Gprim)

    def attribute(self, name: str) -> Usd.Attribute:
        """The attribute that holds an input's value, which may be another one that the input is connected to."""
        current = self.prim.GetAttribute(f"inputs:{name}")
        legacy = self.prim.GetAttribute(name)
        if (
            self._may_be_legacy
            and legacy
            and legacy.HasAuthoredValue()
            and not (current and current.HasAuthoredValue())
        ):
            self.warn("legacy inputs without the prefix 'inputs:' are used")
            return legacy
        if current and current.HasAuthoredConnections():
            return self._value_source(current)
        return current

    def _value_source(self, connected: Usd.Attribute) -> Usd.Attribute:
        """The input that a connection leads to; shaders are not evaluated."""
        sources = UsdShade.Utils.GetValueProducingAttributes(UsdShade.Input(connected))
        if len(sources) == 1 and UsdShade.Input.IsInput(sources[0]):
            return sources[0]
        self.warn(f"{connected.GetName()}: the connected shader is not evaluated; the input's own value is used")
        return connected

    def authored(self, *names: str) -> bool:
        """Whether any of these inputs has an authored value."""
        attributes = (self.attribute(name) for name in names)
        return any(attribute and attribute.HasAuthoredValue() for attribute in attributes)

    def applied(self, schema: type[Usd.APISchemaBase], *names: str) -> bool:
        """Whether a schema is applied to the prim; if not, its inputs `names` are ignored with a warning."""
        applied = bool(self.prim.HasAPI(schema))
        ignored = [] if applied else [name for name in names if self.authored(name)]
        if ignored:
            self.warn(f"{', '.join(ignored)}: ignored, since {schema.__name__} is not applied to the prim")
        return applied

    def number(self, name: str, default: float) -> float:
        """An input as a number."""
        return read.number(self.attribute(name), self.time, default)

    def flag(self, name: str, default: bool = False) -> bool:
        """An input as a truth value; almost all fallbacks of UsdLux are False."""
        return read.flag(self.attribute(name), self.time, default)

    def text(self, name: str, default: str = "") -> str:
        """An input as a token."""
        return read.text(self.attribute(name), self.time, default)

    def asset(self, name: str) -> Sdf.AssetPath | None:
        """An input as an asset; None: it names no file."""
        path = read.raw(self.attribute(name), self.time)
        return path if isinstance(path, Sdf.AssetPath) and path.path != "" else None

    def warn(self, what: str) -> None:
        """Warns, naming the light."""
        self._report.warn(self.prim.GetPath(), what)
