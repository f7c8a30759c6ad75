"""Noise that people accept: no regular pattern, and little of it at low frequencies."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

import warp_ir as ir
from warp_ir.procedural import cornell_box, mesh, sphere
from warp_ir.scene import LightKind

pytestmark = pytest.mark.extended

SIZE = 128


def _room():
    """The Cornell box with a faceted ball in the half shadow of two lamps more."""
    points, triangles = sphere(90.0, level=2)
    box = cornell_box()
    lamps = []
    for k, x in enumerate((120.0, 430.0)):
        place = np.eye(4)
        place[:3, 3] = (x, 450.0, 200.0)
        lamps.append(ir.Light(f"lamp{k}", LightKind.SPHERE, (40.0,) * 3, place, radius=12.0))
    ball = mesh("ball", points + np.array([380.0, 90.0, 60.0]), triangles)
    return dataclasses.replace(box, meshes=(*box.meshes, ball), lights=tuple(lamps))


def _differences(iterations, *, filtered):
    """Differences of pictures of different seeds, over their deviation nearby: no edges, no bias, only noise."""
    pictures = []
    for seed in range(4):
        settings = ir.RenderSettings(
            width=SIZE, height=SIZE, iterations=iterations, light_paths=4096, filter=filtered, seed=seed
        )
        pictures.append(ir.render(_room(), settings).radiance().astype(np.float64).mean(axis=2))
    differences = np.array(pictures[::2]) - np.array(pictures[1::2])
    return differences / np.sqrt(uniform_filter(differences**2, (0, 15, 15)) + 1e-20)


def _spectrum(differences):
    """The power spectrum, mean of the differences, and the frequency [1/pixel] of each entry."""
    power = (np.abs(np.fft.fft2(differences)) ** 2).mean(axis=0)
    f = np.fft.fftfreq(SIZE)
    return power, np.hypot(f[:, None], f[None, :])


@pytest.mark.parametrize("iterations", [1, 4])
@pytest.mark.parametrize("filtered", [False, True])
def test_no_regular_pattern(iterations, filtered):
    """No frequency above 1/4 per pixel has 12 times the power of those of its length; a weave has hundreds of times.

    Without a pattern the mean power of two pictures has a Γ distribution of shape 2: the largest of 6400 frequencies
    exceeds 12 once in 10⁵ pictures.
    """
    power, frequency = _spectrum(_differences(iterations, filtered=filtered))
    ring = np.digitize(frequency, np.linspace(0.25, 0.5, 9))
    mean = np.bincount(ring.ravel(), power.ravel()) / np.bincount(ring.ravel())
    assert (power / mean[ring])[frequency > 0.25].max() < 12.0


@pytest.mark.parametrize("iterations", [1, 4])
def test_noise_is_blue(iterations):
    """Unfiltered, the power at 1/16 to 1/8 per pixel is less than above 1/4: white noise has as much.

    The ratio of white noise is 1 ± 0.04: half of 600 frequencies of two pictures are independent.
    """
    power, frequency = _spectrum(_differences(iterations, filtered=False))
    low = power[(frequency > 1 / 16) & (frequency < 1 / 8)].mean()
    assert low < 0.88 * power[frequency > 0.25].mean()
