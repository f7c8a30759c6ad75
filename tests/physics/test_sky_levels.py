"""From the file to the picture: skies in every layout and orientation, photometry, links and shadows."""

import math

import numpy as np
import pytest

from tests.physics.closed_form import placed, rotation
from tests.physics.level import EYE, assert_level, at, check, floor, level, light, load, mesh, panel
from tests.stages import photometry, sky_directions, write_image

pytestmark = pytest.mark.extended

TURN = rotation(1, 65.0) @ rotation(0, 25.0) @ rotation(2, -40.0)


@pytest.mark.parametrize("layout", ["latlong", "automatic", "angular", "mirroredBall", "cubeMapVerticalCross"])
@pytest.mark.parametrize("kind, axis, pole, up", [
    ("DomeLight", "", "Y", "Y"), ("DomeLight", "", "Y", "Z"), ("DomeLight_1", "scene", "Y", "Y"),
    ("DomeLight_1", "scene", "Z", "Z"), ("DomeLight_1", "Y", "Y", "Z"), ("DomeLight_1", "Z", "Z", "Y"),
])  # fmt: skip
def test_skies(tmp_path, layout, kind, axis, pole, up):
    """Under L = 2 + d, a channel for each axis of the dome, a floor with the normal n has E = 2π + (2π/3) d(n).

    So a single picture tells where each of the dome's axes points. Exposure, colour, temperature and diffuse multiply
    it; scale, translation and normalize do nothing.
    """
    if layout not in ("latlong", "angular") and (kind, up) != ("DomeLight_1", "Z"):
        pytest.skip("layouts and orientations are independent of each other")
    size = 192 if layout in ("angular", "mirroredBall") else 48
    image = 2.0 + np.nan_to_num(sky_directions("latlong" if layout == "automatic" else layout, size))
    write_image(tmp_path / "sky.exr", image.astype(np.float32))
    more = f"""asset inputs:texture:file = @sky.exr@
    {f'token inputs:texture:format = "{layout}"' if layout != "latlong" else ""}
    {f'uniform token poleAxis = "{axis}"' if axis else ""}
    float inputs:intensity = 3
    float inputs:exposure = -1
    color3f inputs:color = (0.5, 1, 0.25)
    bool inputs:enableColorTemperature = true
    float inputs:colorTemperature = 3000
    bool inputs:normalize = true
    float inputs:diffuse = 0.5"""
    scale = np.diag([2.0, 0.5, 3.0])
    normal = TURN.T @ [0.0, 1.0, 0.0]
    if pole == "Z":  # the image's frame is turned about X, so that its +Y lies along +Z
        normal = rotation(0, -90.0) @ normal
    factor = 3.0 * 0.5 * 0.5 * np.array([0.5, 1.0, 0.25]) * [1.771, 0.844, 0.272]
    expected = factor * (2.0 * math.pi + 2.0 * math.pi / 3.0 * normal)
    head = f'#usda 1.0\n(upAxis = "{up}")\n'
    text = head + floor() + EYE + light(kind, more, placed(TURN @ scale, (9.0, -7.0, 5.0)))
    found = level(load(tmp_path, text), "vpl", iterations=16)
    assert_level(found / factor, expected / factor / math.pi, 0.01)


@pytest.mark.parametrize("suffix", ["hdr", "exr", "png"])
def test_a_sun_in_a_sky(tmp_path, suffix):
    """One bright texel of an image stands where it should: E = L Ω cosθ, Ω its solid angle."""
    n, row, column = 64, 12, 40
    image = np.zeros((n, 2 * n, 3), np.float32)
    image[row, column] = (1.0, 0.5, 0.25) if suffix != "png" else 1.0
    if suffix == "png":
        write_image(tmp_path / "sky.png", (image * 255).astype(np.uint8), "uint8")
    else:
        write_image(tmp_path / f"sky.{suffix}", image)
    theta = (row + 0.5) / n * math.pi
    phi = math.pi - (column + 0.5) / n * math.pi
    local = np.array([math.sin(theta) * math.sin(phi), math.cos(theta), math.sin(theta) * math.cos(phi)])
    turn = rotation(0, 30.0) @ rotation(1, 100.0)
    # Bilinear lookups spread the texel over a tent, whose integral is that of the texel.
    expected = 1e3 * image[row, column] * (math.pi / n) ** 2 * math.sin(theta) * (turn @ local)[1]
    more = f"asset inputs:texture:file = @sky.{suffix}@\n    float inputs:intensity = 1000"
    check(tmp_path, light("DomeLight", more, placed(turn)), expected, iterations=64, path=suffix == "exr")


HEIGHT = 1.6


def lamp(across, above, more=""):
    """A point whose -Z is turned so far from the direction of the origin below; its intensity is 1 / 4."""
    a, b = math.radians(across), math.radians(above)
    local = np.array([math.sin(a) * math.cos(b), math.sin(b), -math.cos(a) * math.cos(b)])
    # Turn the local direction to the world's -Y.
    axis = np.cross(local, [0.0, -1.0, 0.0])
    cosine = -local[1]
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + cross + cross @ cross / (1.0 + cosine)
    shape = f"""bool treatAsPoint = true
    bool inputs:normalize = true
    asset inputs:shaping:ies:file = @lamp.ies@
    {more}"""
    return light("SphereLight", shape, placed(turn, (0.0, HEIGHT, 0.0)), '"ShapingAPI"')


@pytest.mark.parametrize("scale", [0.0, 0.5, 2.0, -2.0])
@pytest.mark.parametrize("normalize", [False, True])
def test_photometry(tmp_path, scale, normalize):
    """E = I f(θ) / d², f in candela, 100 at 0° and less by 1 a degree, over its mean of the hemisphere if normalized.

    θ in the file is θ / scale, or (θ - π) / -scale + π. The mean is ∫ f sinθ dθ = 100 - 180/π.
    """
    (tmp_path / "lamp.ies").write_text(photometry([0, 90, 180], [0], [[50, 5, -40]], factor=2))
    angle = 25.0
    theta = {0.0: angle, 0.5: angle / 0.5, 2.0: angle / 2.0, -2.0: (angle - 180.0) / 2.0 + 180.0}[scale]
    candela = np.interp(theta, [0, 90, 180], [100, 10, 0])
    if normalize:
        # Of the whole sphere: ½ ∫ f sinθ dθ over both parts, whose integrals are 100 - 90 · 2/π and 10 · 2/π.
        candela /= 0.5 * (100.0 - 90.0 * 2.0 / math.pi + 10.0 * 2.0 / math.pi)
    more = f"float inputs:shaping:ies:angleScale = {scale}"
    more += f"\n    bool inputs:shaping:ies:normalize = {str(normalize).lower()}"
    # A cone of 180° so that the profile alone says how it shines.
    more += "\n    float inputs:shaping:cone:angle = 180"
    check(tmp_path, lamp(0.0, angle, more), 0.25 * candela / HEIGHT**2, path=False, iterations=2)


@pytest.mark.parametrize("kind", ["A", "B", "C"])
def test_types_of_photometry(tmp_path, kind):
    """Types A and B count across to +X and up to +Y from the aim; C the azimuth from +X towards +Y around it."""
    angles = [-90, 0, 90]
    places = {(30.0, 0.0): 50 + 50 / 3, (0.0, 30.0): 50 + 10 / 3, (-30.0, 0.0): 40.0, (0.0, -30.0): 50 - 10 / 3}
    text = photometry(angles, angles, [[10, 20, 30], [40, 50, 60], [90, 100, 110]], kind=3 if kind == "A" else 2)
    if kind == "C":
        azimuths, candela = [0, 90, 180, 270, 360], [100, 200, 50, 10, 100]
        text = photometry([0, 90], azimuths, [[x, 0] for x in candela])
        for a, b in ((20.0, 20.0), (-30.0, 10.0), (-10.0, -40.0), (25.0, -15.0)):
            x, y = math.radians(a), math.radians(b)
            phi = math.degrees(math.atan2(math.sin(y), math.sin(x) * math.cos(y))) % 360.0
            theta = math.degrees(math.acos(math.cos(x) * math.cos(y)))
            places[a, b] = np.interp(phi, azimuths, candela) * (1.0 - theta / 90.0)
        places = dict(list(places.items())[4:])
    (tmp_path / "lamp.ies").write_text(text)
    for (across, above), candela in places.items():
        check(tmp_path, lamp(across, above), 0.25 * candela / HEIGHT**2, path=False, iterations=2)


LAMPS = {
    "RectLight": light("RectLight", "%s", placed(rotation(0, -90.0), (0.0, 2.0, 0.0)), "%a"),
    "SphereLight": light("SphereLight", "%s", placed(np.eye(3), (0.1, 2.0, 0.0)), "%a"),
    "CylinderLight": light("CylinderLight", "%s", placed(np.eye(3), (0.1, 2.0, 0.0)), "%a"),
    "DistantLight": light("DistantLight", "float inputs:angle = 5\n    %s", placed(rotation(0, -80.0)), "%a"),
    "DomeLight": light("DomeLight", "%s", placed(np.eye(3)), "%a"),
    "mesh": panel("%s", placed(rotation(0, -90.0), (0.0, 2.0, 0.0)), '"MeshLightAPI", %a'),
}


@pytest.mark.parametrize("kind", LAMPS)
def test_links_and_shadows(tmp_path, kind):
    """What a light is linked to has E with what is linked to cast shadows in between, and 0 if not linked at all.

    A lid between them takes all light but a sky's from the sides; with shadows off, or off its list, none of it.
    """
    lid = mesh("Lid", [(-4, 0.5, 4), (4, 0.5, 4), (4, 0.5, -4), (-4, 0.5, -4)])

    def found(more="", between=""):
        lamp = LAMPS[kind].replace("%s", more).replace("%a", '"ShadowAPI"')
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        return level(load(folder, floor() + EYE + lamp + between), "vpl", iterations=8)[0]

    free, shadowed = found(), found("", lid)
    assert (shadowed < 0.05 * free) if kind == "DomeLight" else shadowed == 0.0
    assert found("rel collection:lightLink:excludes = </Floor>") == 0.0
    assert_level(found("rel collection:lightLink:excludes = </Lid>", lid), shadowed) if shadowed else None
    for more in (
        "bool inputs:shadow:enable = false",
        "rel collection:shadowLink:excludes = </Lid>",
        "uniform bool collection:shadowLink:includeRoot = false\n    rel collection:shadowLink:includes = </Floor>",
        "uniform bool collection:shadowLink:includeRoot = false",
    ):
        assert_level(found(more, lid), free, 2e-3)


@pytest.mark.parametrize("written", [True, False], ids=["written out", "stored once"])
def test_links_to_instances(tmp_path, written, monkeypatch):
    """A light may leave out one of a prototype's instances: that one is black, and casts no shadow if so linked."""
    if not written:
        monkeypatch.setattr("warp_ir.usd.geometry.prototypes.MAX_FLATTENED_TRIANGLES", 0)
    tile = 'over "Proto" {' + floor(name="Tile", size=0.4) + "}\n"
    for k, place in enumerate([(0, 0, 0), (2, 0, 0), (0, 0.5, 0)]):
        where = at(placed(np.eye(3), place))
        tile += f'def Xform "I{k}" (instanceable = true\n prepend references = </Proto>) {{\n {where} }}\n'

    def found(more, text=tile):
        return level(load(tmp_path, EYE + text + lamp.replace("%s", more)), "vpl", iterations=8)[0]

    lamp = light("SphereLight", "float inputs:radius = 0.1\n    %s", placed(np.eye(3), (0.0, 2.0, 0.0)))
    free = math.pi * 0.01 / 4.0 / math.pi
    assert found("") == 0.0
    assert_level(found("rel collection:shadowLink:excludes = </I2>"), free, 2e-3)
    assert_level(found("rel collection:shadowLink:excludes = </I2/Tile>"), free, 2e-3)
    both = "rel collection:shadowLink:excludes = </I2>\n    rel collection:lightLink:excludes = "
    assert found(both + "</I0>") == 0.0
    assert_level(found(both + "</I1>"), free, 2e-3)


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_the_default_sky(tmp_path, up):
    """The ground of the overcast sky has E = π; a wall, E by quadrature of sky and ground over the half space."""
    head = f'#usda 1.0\n(upAxis = "{up}")\n'
    found = level(
        load(tmp_path, head + floor() + EYE, default_light="sky", warnings=["overcast"]), "vpl", iterations=16
    )
    expected = 1.0
    if up == "Z":  # the floor of the plane y = 0 stands upright
        elevation, azimuth = np.meshgrid(
            (np.arange(1000) + 0.5) * math.pi / 1000 - 0.5 * math.pi, (np.arange(500) + 0.5) * math.pi / 500
        )
        radiance = np.where(elevation > 0.0, 9.0 / 7.0 * (1.0 + 2.0 * np.sin(elevation)) / 3.0, 0.25)
        projected = radiance * np.cos(elevation) ** 2 * np.sin(azimuth)
        expected = float(projected.sum() * (math.pi / 1000) * (math.pi / 500)) / math.pi
    assert_level(found, np.full(3, expected), 0.01)
