"""What a point of a surface reflects: a diffuse base below microfacets, below a clearcoat.

The layers are those of UsdPreviewSurface, and of the base, specular and coat layers of MaterialX's surfaces:

    coat      w V D F           F from (ior - 1)²/(ior + 1)² to 1, w = clearcoat
    gloss     V D F             F from F0 to F90, by Schlick 1994
    diffuse   ρ/π T(μi) T(μo) / ∫ 2μ T dμ

A layer that reflects E(μ) lets T(μ) = 1 - E(μ) of the light through on its way in, and on its way out. So the diffuse
base has the albedo ρ T(μo), as in MaterialX, but directions may be exchanged, and nothing is gained at ρ = 1: the
normalisation is the share of light that reaches the base from all directions. Directions are in a frame whose z axis is
the shading normal; `i` points to the light and `o` to the eye.
"""

import warp as wp

from warp_ir.bsdf.albedo_table import MIRROR_ALPHA, AlbedoTable, albedo_terms, mean_albedo_terms
from warp_ir.bsdf.ggx import ggx_density, ggx_visibility, reflected_pdf, sample_visible_normal
from warp_ir.sampling.square_to import square_to_cosine_hemisphere

wp.set_module_options({"enable_backward": False})

_MIRROR = wp.constant(MIRROR_ALPHA)
_LEAST_SHARE = wp.constant(1.0e-4)  # of light that reaches the base, below a layer that reflects all
_NODES = wp.constant(16)  # of the integral over a coated base


@wp.struct
class Bsdf:
    """The parameters of a point; without gloss and coat it is Lambertian."""

    diffuse: wp.vec3  # albedo ρ of the base
    f0: wp.vec3  # reflectance of the microfacets at normal incidence
    f90: wp.vec3  # at grazing incidence
    alpha: float  # of the microfacets: roughness²
    coat: float  # weight of the clearcoat, in [0, 1]
    coat_f0: float
    coat_alpha: float


@wp.struct
class BsdfSample:
    """A sampled direction."""

    direction: wp.vec3  # to the light; (0, 0, 0): the light path ends
    weight: wp.vec3  # f cosθ / pdf
    diffuse: wp.vec3  # part of the weight that the diffuse base reflects
    pdf: float  # per solid angle, of all lobes together; -1: of a mirror, which has none


@wp.func
def fresnel(f0: wp.vec3, f90: wp.vec3, cosine: float) -> wp.vec3:
    """Reflectance of a facet by the cosine between its normal and a direction (Schlick 1994)."""
    c = wp.clamp(1.0 - cosine, 0.0, 1.0)
    return f0 + (f90 - f0) * (c * c * c * c * c)


@wp.func
def _grey(v: wp.vec3) -> float:
    return (v[0] + v[1] + v[2]) / 3.0


@wp.func
def gloss_albedo(b: Bsdf, table: AlbedoTable, cosine: float) -> wp.vec3:
    """What the microfacets reflect of light from everywhere."""
    terms = albedo_terms(table, cosine, b.alpha)
    return b.f0 * terms[0] + b.f90 * terms[1]


@wp.func
def coat_albedo(b: Bsdf, table: AlbedoTable, cosine: float) -> float:
    """What the clearcoat reflects of light from everywhere, its weight included."""
    if b.coat <= 0.0:
        return 0.0
    terms = albedo_terms(table, cosine, b.coat_alpha)
    return b.coat * (b.coat_f0 * terms[0] + terms[1])


@wp.func
def _to_base(b: Bsdf, table: AlbedoTable, cosine: float) -> float:
    """Share of the light at an angle that passes both layers."""
    return (1.0 - coat_albedo(b, table, cosine)) * (1.0 - _grey(gloss_albedo(b, table, cosine)))


@wp.func
def _mean_to_base(b: Bsdf, table: AlbedoTable) -> float:
    """Share of light from everywhere that passes both layers, ∫ 2μ T dμ."""
    if b.coat <= 0.0:
        terms = mean_albedo_terms(table, b.alpha)
        return wp.max(1.0 - _grey(b.f0) * terms[0] - _grey(b.f90) * terms[1], _LEAST_SHARE)
    total = float(0.0)
    norm = float(0.0)
    for k in range(_NODES):
        t = (float(k) + 0.5) / float(_NODES)  # √μ, in which the table is smooth
        total += t * t * t * _to_base(b, table, t * t)
        norm += t * t * t
    return wp.max(total / norm, _LEAST_SHARE)


@wp.func
def directional_albedo(b: Bsdf, table: AlbedoTable, cosine: float) -> wp.vec3:
    """Share of light from everywhere that is reflected to the eye; below a rough coat it is an estimate."""
    coat = coat_albedo(b, table, cosine)
    gloss = gloss_albedo(b, table, cosine)
    return wp.vec3(coat) + (1.0 - coat) * (gloss + (1.0 - _grey(gloss)) * b.diffuse)


@wp.func
def diffuse_part(b: Bsdf, table: AlbedoTable, i: wp.vec3, o: wp.vec3) -> wp.vec3:
    """What the base reflects [1/sr]."""
    if i[2] <= 0.0 or o[2] <= 0.0 or wp.max(b.diffuse) <= 0.0:
        return wp.vec3(0.0)
    passing = _to_base(b, table, i[2]) * _to_base(b, table, o[2])
    return b.diffuse * (passing / (wp.pi * _mean_to_base(b, table)))


@wp.func
def glossy_part(b: Bsdf, table: AlbedoTable, i: wp.vec3, o: wp.vec3) -> wp.vec3:
    """What rough microfacets and a rough clearcoat reflect [1/sr]."""
    value = wp.vec3(0.0)
    if i[2] <= 0.0 or o[2] <= 0.0:
        return value
    h = wp.normalize(i + o)
    x = wp.dot(i, h)
    if b.alpha >= _MIRROR and wp.max(b.f90) > 0.0:
        uncoated = (1.0 - coat_albedo(b, table, i[2])) * (1.0 - coat_albedo(b, table, o[2]))
        value += fresnel(b.f0, b.f90, x) * (uncoated * ggx_density(h, b.alpha) * ggx_visibility(i, o, b.alpha))
    if b.coat > 0.0 and b.coat_alpha >= _MIRROR:
        f = fresnel(wp.vec3(b.coat_f0), wp.vec3(1.0), x)
        value += f * (b.coat * ggx_density(h, b.coat_alpha) * ggx_visibility(i, o, b.coat_alpha))
    return value


@wp.func
def evaluate(b: Bsdf, table: AlbedoTable, i: wp.vec3, o: wp.vec3) -> wp.vec3:
    """The BSDF [1/sr] without mirrors."""
    return diffuse_part(b, table, i, o) + glossy_part(b, table, i, o)


@wp.func
def _lobe_probabilities(b: Bsdf, table: AlbedoTable, cosine: float) -> wp.vec3:
    """Probabilities with which the lobes are sampled: diffuse, gloss, coat; 0 if nothing is reflected."""
    coat = coat_albedo(b, table, cosine)
    gloss = gloss_albedo(b, table, cosine)
    shares = wp.vec3((1.0 - coat) * (1.0 - _grey(gloss)) * _grey(b.diffuse), (1.0 - coat) * _grey(gloss), coat)
    total = shares[0] + shares[1] + shares[2]
    if total <= 0.0:
        return wp.vec3(0.0)
    return shares / total


@wp.func
def bsdf_pdf(b: Bsdf, table: AlbedoTable, i: wp.vec3, o: wp.vec3) -> float:
    """The pdf per solid angle with which `sample_bsdf` samples a direction, mirrors left out."""
    if i[2] <= 0.0 or o[2] <= 0.0:
        return 0.0
    p = _lobe_probabilities(b, table, o[2])
    h = wp.normalize(i + o)
    pdf = p[0] * i[2] / wp.pi
    if b.alpha >= _MIRROR:
        pdf += p[1] * reflected_pdf(h, o, b.alpha)
    if b.coat_alpha >= _MIRROR:
        pdf += p[2] * reflected_pdf(h, o, b.coat_alpha)
    return pdf


@wp.func
def _sample_mirror(b: Bsdf, table: AlbedoTable, o: wp.vec3, of_coat: bool, probability: float) -> BsdfSample:
    out = BsdfSample()
    out.direction = wp.vec3(-o[0], -o[1], o[2])
    out.pdf = -1.0
    if of_coat:
        out.weight = fresnel(wp.vec3(b.coat_f0), wp.vec3(1.0), o[2]) * (b.coat / probability)
    else:
        uncoated = 1.0 - coat_albedo(b, table, o[2])
        out.weight = fresnel(b.f0, b.f90, o[2]) * (uncoated * uncoated / probability)
    return out


@wp.func
def sample_bsdf(b: Bsdf, table: AlbedoTable, o: wp.vec3, u_lobe: float, u: wp.vec2) -> BsdfSample:
    """Samples a direction in proportion to about f cosθ."""
    out = BsdfSample()
    p = _lobe_probabilities(b, table, o[2])
    if o[2] <= 0.0 or p[0] + p[1] + p[2] <= 0.0:
        return out
    if u_lobe < p[0]:
        out.direction = square_to_cosine_hemisphere(u, wp.vec3(0.0, 0.0, 1.0))
    else:
        of_coat = u_lobe >= p[0] + p[1]
        alpha = wp.where(of_coat, b.coat_alpha, b.alpha)
        if alpha < _MIRROR:
            return _sample_mirror(b, table, o, of_coat, wp.where(of_coat, p[2], p[1]))
        h = sample_visible_normal(o, alpha, u)
        out.direction = wp.normalize(2.0 * wp.dot(o, h) * h - o)
    if out.direction[2] <= 0.0:
        out.direction = wp.vec3(0.0)
        return out
    out.pdf = bsdf_pdf(b, table, out.direction, o)
    if not out.pdf > 0.0:
        out.direction = wp.vec3(0.0)
        return out
    per_pdf = out.direction[2] / out.pdf
    out.diffuse = diffuse_part(b, table, out.direction, o) * per_pdf
    out.weight = out.diffuse + glossy_part(b, table, out.direction, o) * per_pdf
    return out
