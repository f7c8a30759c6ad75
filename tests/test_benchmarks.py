"""The benchmarks measure what they say: floors are subtracted, equal time is equal, and a loss of speed is caught."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from warp_ir.procedural import furnace

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(autouse=True)
def _benchmarks_on_path(monkeypatch):
    """They are programs: each finds the others beside it."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def row(method="vpl", budget=1.0, seconds=1.0, error=0.01, floor=0.0, **more):
    """A line of results."""
    return {
        "scene": "box",
        "method": method,
        "budget": budget,
        "seconds": seconds,
        "error": error,
        "floor": floor,
        "mean_ratio": 0.0,
        "samples": 1,
        **more,
    }


def perfect_task(noise):
    """A furnace, whose radiance 2 is known, with a reference that is noisy and knows by how much."""
    from methods import Task

    random = np.random.default_rng(1)
    reference = 2.0 + noise * random.normal(size=(16, 16, 3))
    error = np.full_like(reference, noise)
    floor = float(np.mean(error**2 / (reference**2 + 0.01 * reference.mean() ** 2)))
    return Task("furnace", furnace(level=2), reference, error, floor)


class Perfect:
    """A method that knows the answer."""

    name = "perfect"

    def render(self, seconds, seed):
        from methods import Run

        return Run(np.full((16, 16, 3), 2.0), seconds, 1)


def test_reference_noise_is_not_charged():
    """A perfect picture scores 0 against a noisy reference, within the scatter of a χ² of 768 values."""
    from run import measure

    task = perfect_task(noise=0.1)
    (run,) = measure(task, [Perfect()], [0.1], 1)
    assert abs(run["error"]) < 4.0 * math.sqrt(2.0 / 768) * task.floor
    assert abs(run["mean_ratio"]) < 4.0 * 0.05 / math.sqrt(768)


@pytest.mark.extended
def test_our_estimators_keep_to_the_budget_and_come_close():
    """Each estimator takes about the time it is given, and gets the furnace right within 10 %."""
    from methods import own_methods
    from run import measure

    task = perfect_task(noise=0.0)
    methods = [method for name, method in own_methods("cpu").items() if name != "vpl-denoised"]
    for method in methods:
        assert set(method.prepare(task, [0.05])) == {"compile", "upload"}
    for run in measure(task, methods, [0.05], 1):
        assert 0.0 < run["seconds"] < 5.0
        assert run["error"] < 0.1, run["method"]
        assert abs(run["mean_ratio"]) < 0.1, run["method"]


def test_medians_and_spread():
    """One row per scene, method and budget: the median, the least, the largest."""
    from analysis import summarize

    (only,) = summarize(row(error=error) for error in (0.03, 0.01, 0.02))
    assert (only["error"], only["error_low"], only["error_high"], only["seeds"]) == (0.02, 0.01, 0.03, 3)


def test_equal_time_is_read_off_the_curve():
    """A curve that falls as 1/time is continued as such; one that has levelled off stays level."""
    from analysis import advantage, error_at

    falling = [row(seconds=t, error=0.1 / t) for t in (1.0, 2.0)]
    assert error_at(falling, 1.4) == pytest.approx(0.1 / 1.4)
    assert error_at(falling, 4.0) == pytest.approx(0.1 / 4.0)
    assert error_at(falling[:1], 2.0) == pytest.approx(0.05)
    assert error_at([row(seconds=t, error=0.1) for t in (1.0, 2.0)], 100.0) == pytest.approx(0.1)
    assert error_at(falling, 0.1) is None
    rows = [row("mitsuba", seconds=t, error=0.1 / t) for t in (1.0, 2.0)] + [row(seconds=2.0, error=0.01)]
    assert advantage(rows[-1], rows, "mitsuba") == pytest.approx(5.0)


def test_errors_below_the_reference_noise_do_not_count():
    """Near the floor a smaller error is luck, and a negative one as well: ratios see the same number."""
    from analysis import compare

    _, worse = compare([row(error=1e-6, floor=1e-3)], [row(error=-1e-7, floor=1e-3)])
    assert not worse


@pytest.mark.parametrize(("factor", "code"), [(0.5, 1), (1.0, 0), (2.0, 0)])
def test_compare_fails_if_it_has_become_worse(tmp_path, monkeypatch, factor, code):
    """The exit code is 1 if time x error exceeds the earlier result by 10 %: here the earlier one is `factor` of it."""
    import run

    monkeypatch.setattr(run, "measure_all", lambda *_, **__: ([{**row(), "timings": {}, "counts": {}}], [], {}))
    old = tmp_path / "old.json"
    old.write_text(json.dumps({"rows": [row(error=0.01 * factor)]}))
    assert run.main(["-k", "furnace_cube", "--estimators", "path", "--compare", str(old)]) == code


@pytest.mark.extended
def test_quick_run_writes_everything(tmp_path):
    """Table, numbers with their circumstances, and plot."""
    pytest.importorskip("matplotlib")
    import run

    files = {kind: tmp_path / f"result.{kind}" for kind in ("json", "md", "png")}
    arguments = ["--quick", "-k", "furnace_cube", "--estimators", "path", "vpl", "--seconds", "0.05"]
    arguments += ["--json", str(files["json"]), "--markdown", str(files["md"]), "--plot", str(files["png"])]
    assert run.main(arguments) == 0
    result = json.loads(files["json"].read_text())
    assert {"date", "commit", "device", "device_name", "cpu_count", "versions"} <= set(result["environment"])
    assert {r["method"] for r in result["rows"]} == {"path", "vpl"}
    assert "| path |" in files["md"].read_text()
    assert files["png"].read_bytes().startswith(b"\x89PNG")


@pytest.mark.extended
def test_rays_are_counted(tmp_path):
    """All types of rays and of evaluations have a speed, and Embree, where it is installed, hits the same triangles."""
    import rays

    assert rays.main(["--quick", "--width", "32", "--json", str(tmp_path / "rays.json")]) == 0
    result = json.loads((tmp_path / "rays.json").read_text())
    assert {row["kind"] for row in result["rays"]} == {"camera", "diffuse", "shadow"}
    for row in result["rays"]:
        assert row["ours"] > 0.0 and row["empty"] > 0.0
        assert row.get("agree", 1.0) > 0.98  # shadow rays end a little before their VPL, by different rules
    assert min(result["gather"][0][key] for key in ("shadowed", "unshadowed", "empty")) > 0.0


def test_the_wrinkled_ball_is_closed():
    """Every edge of the procedural ball that has two ends belongs to two triangles, whatever its size."""
    from scaling import ball

    mesh = ball(1_000)
    points = np.unique(mesh.points.round(9), axis=0, return_inverse=True)[1].reshape(-1)  # the poles are one point each
    corners = points[mesh.triangles]
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    _, counts = np.unique(edges[edges[:, 0] != edges[:, 1]], axis=0, return_counts=True)
    assert (counts % 2 == 0).all()


def test_random_scenes_are_functions_of_their_seed():
    """A seed gives the same scene each time, another seed another, and ten in a row one of each kind."""
    from make_references import content_digest
    from random_scenes import KINDS, random_scene

    scenes = [random_scene(seed) for seed in range(20, 30) if seed % 10 != 8]  # the crowd takes a second
    assert [scene.name.split("_")[0] for scene in scenes] == [kind for kind in KINDS if kind != "crowd"]
    assert content_digest(scenes[0]) == content_digest(random_scene(20)) != content_digest(random_scene(30))
    for scene in scenes:
        assert scene.lights or any(max(material.emission) > 0.0 for material in scene.materials)
        assert 300 < scene.triangle_count < 20_000


@pytest.mark.extended
def test_random_scenes_are_lit_and_seen():
    """What rays against boxes say about a scene, its picture confirms: light comes to where the camera looks."""
    from random_scenes import random_scene

    import warp_ir as ir

    for seed in (40, 42, 45, 47):
        settings = ir.RenderSettings(width=16, height=16, iterations=64, filter=False)
        picture = ir.render(random_scene(seed), settings).radiance().mean(axis=2)
        assert (picture > 0.0).mean() > 0.6
        assert np.isfinite(picture).all()


def test_references_are_pooled_by_their_noise_if_they_agree():
    """Weighted by 1/variance, errors of 1 and 3 become 3 / √10, and a mean ten standard errors off is refused."""
    from make_references import ReferencesDisagree, pooled_reference, relative_mse_floor

    rng = np.random.default_rng(1)

    def rendered(level, noise):
        mean, error = level + noise * rng.standard_normal((64, 64, 3)), np.full((64, 64, 3), noise)
        return {
            "mean": mean,
            "standard_error": error,
            "floor": relative_mse_floor(np.full_like(mean, level), error),
            "level_error": noise / np.sqrt(mean.size),
        }

    pooled = pooled_reference("box", {"one": rendered(10.0, 1.0), "other": rendered(10.0, 3.0)})
    assert pooled["standard_error"] == pytest.approx(3.0 / np.sqrt(10.0), rel=1e-3)
    # The deviation of n normal numbers is known to 1 / √(2n): 5 of these are 3.2 %.
    assert np.std(pooled["mean"] - 10.0) == pytest.approx(3.0 / np.sqrt(10.0), rel=0.032)
    off = 10.0 * np.hypot(1.0, 3.0) / 64.0 / np.sqrt(3.0)
    with pytest.raises(ReferencesDisagree):
        pooled_reference("box", {"one": rendered(10.0, 1.0), "other": rendered(10.0 + off, 3.0)})


def test_patterns_stand_out_from_noise():
    """White noise has no peak; a tenth of its power in one frequency is one.

    The largest of n exponential variables exceeds log(n) + 7 in 0.1 % of all cases; a wave of the amplitude a among
    N values of the variance 1 has the power N a²/4 relative to the mean.
    """
    from perception import pattern_peak

    random = np.random.default_rng(3)
    reference = np.full((128, 128, 3), 0.5)
    noise = random.normal(size=(128, 128, 1)) * np.ones(3)
    assert pattern_peak(reference + noise, reference) < math.log(128 * 128 / 2) + 7.0
    y, x = np.mgrid[:128, :128]
    wave = math.sqrt(0.2) * np.sin(2.0 * math.pi * (40 * x + 24 * y) / 128)[..., None]
    expected = 128**2 * 0.2 / 4.0
    assert 0.5 * expected < pattern_peak(reference + noise + wave, reference) < 1.5 * expected


def test_meshes_are_merged_by_material():
    """The peer gets one shape for each material: the same triangles, in the same places."""
    from make_references import merged

    from warp_ir.procedural import cornell_box

    meshes = cornell_box().meshes
    few = merged(meshes)
    assert len(few) == 4 < len(meshes)
    for found in few:
        assert len(set(found.material.tolist())) == 1

    def corners(parts):
        rows = np.concatenate([mesh.points[mesh.triangles].reshape(-1, 9) for mesh in parts])
        return rows[np.lexsort(rows.T)]

    np.testing.assert_array_equal(corners(few), corners(meshes))


@pytest.mark.extended
@pytest.mark.parametrize("seed", [6, 9])
def test_random_scenes_are_read_back_from_their_stages(tmp_path, seed):
    """The stage of a random scene holds the scene: points to float32, texels to 8 bits of sRGB that are stored."""
    from random_scenes import random_scene, write_usd

    import warp_ir as ir

    scene = random_scene(seed)
    write_usd(scene, tmp_path / "scene.usda")
    read = ir.load_usd(tmp_path / "scene.usda")
    assert not read.warnings
    meshes = {mesh.name.split("/")[-1]: mesh for mesh in read.meshes}
    assert len(meshes) == len(scene.meshes)
    for mesh in scene.meshes:
        other = meshes[mesh.name]
        np.testing.assert_allclose(other.points[other.triangles], mesh.points[mesh.triangles], atol=1e-5)
        own, found = scene.materials[mesh.material[0]], read.materials[other.material[0]]
        np.testing.assert_allclose(found.albedo, own.albedo, atol=1e-3)
    lights = {light.name.split("/")[-1]: light for light in read.lights}
    for light in scene.lights:
        assert lights[light.name].kind == light.kind
        np.testing.assert_allclose(lights[light.name].radiance, light.radiance, rtol=1e-5)
    np.testing.assert_allclose(read.camera.fit(1, 1).window, scene.camera.fit(1, 1).window, rtol=1e-6)


@pytest.mark.extended
def test_the_gpu_check_runs_without_a_gpu(tmp_path):
    """A rehearsal on the CPU: every result is a line of JSON, no way to gather changes a bit, and no ray escapes."""
    import warp as wp

    wp.init()
    script = BENCHMARKS.parent / "scripts" / "gpu_check.py"
    command = [sys.executable, str(script), "--device", "cpu", "--quick", "--out", str(tmp_path), "--minutes", "60"]
    environment = os.environ | {"WARP_CACHE_PATH": str(Path(wp.config.kernel_cache_dir).parent)}
    subprocess.run([*command, "--only", "start", "gathering", "leaks"], check=True, env=environment)
    lines = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    assert {line["step"] for line in lines} == {"start", "gathering", "leaks"}
    assert all(line["ok"] for line in lines)
    assert "## leaks: done" in (tmp_path / "summary.md").read_text()
