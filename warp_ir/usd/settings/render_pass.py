"""RenderPass prims: which prims take part in a render, and with which RenderSettings."""

from pxr import Sdf, Usd, UsdRender

from warp_ir.scene import InputError
from warp_ir.usd.settings.render_spec import render_settings_prims
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report

_UNSUPPORTED = {
    "cameraVisibility": "all prims of the pass are visible to the camera",
    "matte": "no prim is a matte",
}
"""Collections that are not supported, and what is done instead."""


class RenderPass:
    """Selects the prims of a render: all but the pruned ones, and gprims and lights only if in renderVisibility.

    Args:
        prim: A RenderPass.
        report: Receives warnings.
    """

    def __init__(self, prim: Usd.Prim, report: Report) -> None:
        self.path = str(prim.GetPath())
        targets = read.targets(UsdRender.Pass(prim).GetRenderSourceRel())
        valid = {settings.GetPath() for settings in render_settings_prims(prim.GetStage())}
        settings = [path for path in targets if path in valid]
        self.settings = str(settings[0]) if settings else ""
        """Path of its RenderSettings; "" if it targets none."""
        if len(targets) != 1 or not settings:
            what = f"{self.settings} is used" if settings else "the stage's are used"
            report.warn(prim.GetPath(), f"renderSource must target one RenderSettings prim; {what}")
        self._pruned = Usd.CollectionAPI(prim, "prune").ComputeMembershipQuery()
        self._visible = Usd.CollectionAPI(prim, "renderVisibility").ComputeMembershipQuery()
        for name, instead in _UNSUPPORTED.items():
            if _is_authored(Usd.CollectionAPI(prim, name)):
                report.warn(prim.GetPath(), f"its collection {name} is not supported: {instead}")

    def prunes(self, prim: Usd.Prim) -> bool:
        """Whether a prim is pruned, with all its descendants."""
        return includes(self._pruned, prim.GetPath())

    def shows(self, prim: Usd.Prim) -> bool:
        """Whether a gprim or a light is in renderVisibility."""
        return includes(self._visible, prim.GetPath())


def find_render_pass(stage: Usd.Stage, name: str | None, report: Report) -> RenderPass | None:
    """The pass of this path or name; None: no name is given.

    Raises:
        InputError: There is no pass of that name, or there are several.
    """
    if name is None:
        return None
    passes = [prim for prim in stage.Traverse() if prim.IsA(UsdRender.Pass)]
    named = [prim for prim in passes if str(prim.GetPath()) == name]
    named = named or [prim for prim in passes if prim.GetName() == name]
    if len(named) > 1:
        paths = ", ".join(str(prim.GetPath()) for prim in named)
        raise InputError(f"{report.source}: {len(named)} render passes are named '{name}': {paths}; give a path")
    if not named:
        paths = ", ".join(str(prim.GetPath()) for prim in passes) or "none"
        raise InputError(f"{report.source}: no render pass '{name}'; available: {paths}")
    return RenderPass(named[0], report)


def includes(query: Usd.UsdCollectionMembershipQuery, path: Sdf.Path) -> bool:
    """Whether a collection contains a path."""
    included = query.IsPathIncluded(path)
    return bool(included[0] if isinstance(included, tuple) else included)


def _is_authored(collection: Usd.CollectionAPI) -> bool:
    """Whether the members of a collection are authored."""
    return any(
        attribute and attribute.HasAuthoredValue()
        for attribute in (collection.GetIncludeRootAttr(), collection.GetMembershipExpressionAttr())
    ) or any(
        relationship and relationship.HasAuthoredTargets()
        for relationship in (collection.GetIncludesRel(), collection.GetExcludesRel())
    )
