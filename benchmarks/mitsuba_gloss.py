"""Our gloss as a BSDF of Mitsuba, on its own microfacets and sampling: a referee for transport, not for the formulas.

What the diffuse base receives (`albedo_table.py`) is read from our table. Parameters are constants.
"""

from types import ModuleType
from typing import Any

import numpy as np

from warp_ir.bsdf.albedo_table import SIZE, albedo_table
from warp_ir.scene import Gloss


def register(mi: ModuleType) -> None:
    """Makes the plugin "gloss" known to the present variant of Mitsuba."""
    import drjit as dr

    terms, means = albedo_table()
    flat = mi.Float(terms.reshape(-1).astype(np.float32))

    def lookup(cosine: Any, roughness: float) -> tuple[Any, Any]:
        y = min(max(roughness, 0.0), 1.0) * (SIZE - 1)
        row = min(int(y), SIZE - 2)
        fy = y - row
        x = dr.sqrt(dr.clip(cosine, 0.0, 1.0)) * (SIZE - 1)
        column = dr.minimum(mi.UInt32(x), SIZE - 2)
        fx = x - mi.Float(column)

        def term(k: int) -> Any:
            def at(r: int, c: Any) -> Any:
                return dr.gather(mi.Float, flat, 2 * (r * SIZE + c) + k)

            low = at(row, column) * (1 - fx) + at(row, column + 1) * fx
            high = at(row + 1, column) * (1 - fx) + at(row + 1, column + 1) * fx
            return low * (1 - fy) + high * fy

        return term(0), term(1)

    class GlossBsdf(mi.BSDF):  # type: ignore[misc]  # Mitsuba's types are made at run time
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.diffuse = mi.Color3f(*[float(props[f"rho_{k}"]) for k in range(3)])
            self.f0 = mi.Color3f(*[float(props[f"f0_{k}"]) for k in range(3)])
            self.f90 = mi.Color3f(*[float(props[f"f90_{k}"]) for k in range(3)])
            self.roughness = float(props["roughness"])
            self.alpha = self.roughness**2
            y = self.roughness * (SIZE - 1)
            row = min(int(y), SIZE - 2)
            mean = means[row] * (1 - (y - row)) + means[row + 1] * (y - row)
            grey0, grey90 = (float(np.mean([float(props[f"{n}_{k}"]) for k in range(3)])) for n in ("f0", "f90"))
            self.grey = grey0, grey90
            self.norm = max(1.0 - grey0 * mean[0] - grey90 * mean[1], 1e-4)
            reflection = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [reflection]
            self.m_flags = reflection

        def _value(self, wi: Any, wo: Any) -> Any:
            h = dr.normalize(wi + wo)
            x = dr.dot(wi, h)
            f = self.f0 + (self.f90 - self.f0) * dr.clip(1 - x, 0, 1) ** 5
            distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)
            a2 = self.alpha**2
            i, o = mi.Frame3f.cos_theta(wo), mi.Frame3f.cos_theta(wi)
            height = i * dr.sqrt(a2 + (1 - a2) * o * o) + o * dr.sqrt(a2 + (1 - a2) * i * i)
            glossy = f * (distribution.eval(h) * 0.5 / height)
            passing = 1.0
            for cosine in (i, o):
                a, b = lookup(cosine, self.roughness)
                passing = passing * (1.0 - self.grey[0] * a - self.grey[1] * b)
            return glossy + self.diffuse * (passing / (dr.pi * self.norm))

        def _pdf(self, wi: Any, wo: Any) -> Any:
            h = dr.normalize(wi + wo)
            distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)
            return 0.5 * mi.warp.square_to_cosine_hemisphere_pdf(wo) + 0.5 * distribution.pdf(wi, h) / (
                4 * dr.abs(dr.dot(wo, h))
            )

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> Any:
            flip = dr.select(si.wi.z < 0, -1.0, 1.0)
            wi = mi.Vector3f(si.wi.x, si.wi.y, si.wi.z * flip)
            distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)
            h, _ = distribution.sample(wi, sample2)
            wo = dr.select(sample1 < 0.5, mi.warp.square_to_cosine_hemisphere(sample2), mi.reflect(wi, h))
            good = active & (wi.z > 0) & (wo.z > 0)
            pdf = dr.select(good, self._pdf(wi, wo), 0.0)
            bs = mi.BSDFSample3f()
            bs.wo = mi.Vector3f(wo.x, wo.y, wo.z * flip)
            bs.pdf = pdf
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = mi.UInt32(0)
            value = dr.select(good & (pdf > 0), self._value(wi, wo) * wo.z / pdf, 0.0)
            return bs, value

        def _both(self, si: Any, wo: Any) -> tuple[Any, Any, Any]:
            flip = dr.select(si.wi.z < 0, -1.0, 1.0)
            wi = mi.Vector3f(si.wi.x, si.wi.y, si.wi.z * flip)
            out = mi.Vector3f(wo.x, wo.y, wo.z * flip)
            return wi, out, (wi.z > 0) & (out.z > 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            wi, out, good = self._both(si, wo)
            return dr.select(good & active, self._value(wi, out) * out.z, 0.0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            wi, out, good = self._both(si, wo)
            return dr.select(good & active, self._pdf(wi, out), 0.0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    mi.register_bsdf("gloss", GlossBsdf)


def description(gloss: Gloss) -> dict[str, Any]:
    """The description of a gloss without textures and clearcoat, for `mitsuba.load_dict`."""
    if gloss.textures or gloss.clearcoat > 0.0:
        raise NotImplementedError("textures or a clearcoat in Mitsuba")
    base = np.array(gloss.base_color)
    if gloss.specular_color is not None:
        f0, f90, diffuse = np.array(gloss.specular_color), np.ones(3), base
    else:
        r = ((1.0 - gloss.ior) / (1.0 + gloss.ior)) ** 2
        f90 = 1.0 - gloss.metallic + base * gloss.metallic
        f0, diffuse = f90 * (r + (1.0 - r) * gloss.metallic), base * (1.0 - gloss.metallic)
    colors = {"rho": diffuse, "f0": f0, "f90": f90}
    numbers = {f"{name}_{k}": float(color[k]) for name, color in colors.items() for k in range(3)}
    return {"type": "gloss", "roughness": gloss.roughness, **numbers}
