"""Passes of a render (UsdRender): what of the scene takes part in one, and whose settings are used."""

from typing import Any

from pxr import Sdf, Usd, UsdRender

from warp_ir.scene import InputError
from warp_ir.usd.settings.render_spec import render_settings_prims
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report

_UNREAD = {
    "cameraVisibility": "all that takes part is seen by the camera",
    "matte": "nothing is a matte",
}
"""Collections that are not honoured, and what is done instead."""


class RenderPass:
    """What takes part in a render: all but what is pruned, and of the gprims and lights only those in renderVisibility.

    Args:
        prim: A RenderPass.
        report: Where troubles go.
    """

    def __init__(self, prim: Usd.Prim, report: Report) -> None:
        self.path = str(prim.GetPath())
        targets = read.targets(UsdRender.Pass(prim).GetRenderSourceRel())
        there = {settings.GetPath() for settings in render_settings_prims(prim.GetStage())}
        settings = [path for path in targets if path in there]
        self.settings = str(settings[0]) if settings else ""
        """Path of its RenderSettings; "" if it names none of the stage."""
        if len(targets) != 1 or not settings:
            what = f"{self.settings} is used" if settings else "the stage's are used"
            report.warn(prim.GetPath(), f"renderSource: its targets are not one RenderSettings prim; {what}")
        self._pruned = Usd.CollectionAPI(prim, "prune").ComputeMembershipQuery()
        self._visible = Usd.CollectionAPI(prim, "renderVisibility").ComputeMembershipQuery()
        for name, instead in _UNREAD.items():
            if _is_authored(Usd.CollectionAPI(prim, name)):
                report.warn(prim.GetPath(), f"its collection {name} is not read: {instead}")

    def prunes(self, prim: Usd.Prim) -> bool:
        """Whether a prim and all below it are left out."""
        return includes(self._pruned, prim.GetPath())

    def shows(self, prim: Usd.Prim) -> bool:
        """Whether a gprim or a light takes part, if nothing above it is pruned."""
        return includes(self._visible, prim.GetPath())


def find_render_pass(stage: Usd.Stage, name: str | None, report: Report) -> RenderPass | None:
    """The pass of a path or name; None if none is wanted.

    Raises:
        InputError: There is none of that name.
    """
    if name is None:
        return None
    there = [prim for prim in stage.Traverse() if prim.IsA(UsdRender.Pass)]
    found = next((prim for prim in there if name in (str(prim.GetPath()), prim.GetName())), None)
    if found is None:
        paths = ", ".join(str(prim.GetPath()) for prim in there) or "none"
        raise InputError(f"{report.source}: no render pass '{name}'; available: {paths}")
    return RenderPass(found, report)


def includes(query: Any, path: Sdf.Path) -> bool:
    """Whether a path is in a collection."""
    included = query.IsPathIncluded(path)
    return bool(included[0] if isinstance(included, tuple) else included)


def _is_authored(collection: Usd.CollectionAPI) -> bool:
    return any(
        found and found.HasAuthoredValue()
        for found in (collection.GetIncludeRootAttr(), collection.GetMembershipExpressionAttr())
    ) or any(
        found and found.HasAuthoredTargets() for found in (collection.GetIncludesRel(), collection.GetExcludesRel())
    )
