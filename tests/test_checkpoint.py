"""Interruption: what has been rendered is not lost, and to go on gives the same bits as never to have stopped."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.cli import main
from warp_ir.image.io import read_image

pytestmark = pytest.mark.extended

SCENES = Path(__file__).parent.parent / "scenes_usd"
ROOM = str(SCENES / "cornell_box.usda")
SMALL = ["--width", "16", "--light-paths", "32", "--device", "cpu"]


@pytest.mark.parametrize("settings", [{}, {"filter": False}, {"estimator": "path"}, {"estimator": "keller"}])
def test_a_film_goes_on_with_the_same_bits(tmp_path, settings, device):
    """Three iterations, saved, and five more in another renderer, are the eight iterations: the filter's sums too."""
    scene = ir.load_usd(ROOM)
    settings = ir.RenderSettings(width=16, light_paths=32, iterations=8, **settings)
    whole = ir.render(scene, settings, device=device)
    renderer = ir.Renderer(scene, settings, device=device)
    film = renderer.new_film()
    for iteration in range(3):
        renderer.add_iteration(film, iteration)
    film.seconds = 2.0
    film.save(tmp_path / "film.npz", key="room")
    renderer = ir.Renderer(scene, settings, device=device)
    film = renderer.new_film()
    film.resume(tmp_path / "film.npz", key="room")
    assert film.iterations == 3 and film.seconds == 2.0
    renderer.render(film)
    assert film.iterations == 8 and film.seconds > 2.0
    np.testing.assert_array_equal(film.radiance(), whole.radiance())
    np.testing.assert_array_equal(film.standard_error(), whole.standard_error())
    for name in ("direct", "indirect", "depth", "prim_id"):
        np.testing.assert_array_equal(film.aov(name), whole.aov(name))


def test_what_is_not_the_film_is_refused(tmp_path):
    """Another key, another size, a file that is damaged or is none."""
    scene, settings = ir.load_usd(ROOM), ir.RenderSettings(width=8, light_paths=16, iterations=1)
    ir.render(scene, settings).save(tmp_path / "film.npz", key="a")
    whole = (tmp_path / "film.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.npz").write_text("no film")
    film = ir.Renderer(scene, settings).new_film()
    wide = ir.Renderer(scene, ir.RenderSettings(width=9, light_paths=16)).new_film()
    for target, name, key in (
        (film, "film.npz", "b"), (wide, "film.npz", "a"), (film, "half.npz", "a"), (film, "text.npz", "a"),
        (film, "gone.npz", "a"),
    ):  # fmt: skip
        with pytest.raises(ir.InputError, match=name):
            target.resume(tmp_path / name, key)
        assert target.iterations == 0 and target.radiance().max() == 0.0


def command(picture, *more):
    return ["render", ROOM, str(picture), *SMALL, *more]


def test_kill_loses_no_more_than_an_interval(tmp_path):
    """Kill -9, then --resume: the picture of a command that was left in peace, bit for bit, and no trace beside it."""
    picture, other = tmp_path / "a.npy", tmp_path / "b.npy"
    film = tmp_path / "a.npy.film.npz"
    begun = [sys.executable, "-m", "warp_ir", *command(picture, "--iterations", "1000000", "--checkpoint", "0.05")]
    process = subprocess.Popen(begun, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60
    while not film.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert film.exists() and not picture.exists()
    done = int(np.load(film)["size"][2])
    assert done > 0
    iterations = str(done + 5)
    resumed = subprocess.run(
        [sys.executable, "-m", "warp_ir", *command(picture, "--iterations", iterations, "--resume")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert f"continues after {done} iterations" in resumed.stderr and f"{iterations} iterations" in resumed.stdout
    assert main(command(other, "--iterations", iterations, "-q")) == 0
    np.testing.assert_array_equal(read_image(picture), read_image(other))
    # What kill leaves of a file half written is hidden and of no meaning.
    assert {name for name in os.listdir(tmp_path) if not name.startswith(".")} == {"a.npy", "b.npy"}


def test_a_resumed_animation_keeps_the_pictures_it_has(tmp_path, caplog):
    """Frames that are there are left alone; those that are not are rendered."""
    stage, output = str(SCENES / "turntable.usda"), str(tmp_path / "#.npy")
    frames = ["render", stage, output, *SMALL, "--iterations", "1", "-q", "--frames"]
    assert main([*frames, "1:2"]) == 0
    (tmp_path / "1.npy").write_bytes(b"mine")
    assert main([*frames, "1:3", "--resume"]) == 0
    assert caplog.text.count("exists and is skipped") == 2
    assert (tmp_path / "1.npy").read_bytes() == b"mine" and read_image(tmp_path / "3.npy").shape[1] == 16


def test_a_checkpoint_of_something_else_is_refused(tmp_path, capsys):
    """Other settings, another scene: one line that says what to do; other limits are no matter."""
    picture = tmp_path / "a.npy"
    scene = ir.load_usd(ROOM)
    settings = ir.RenderSettings(width=16, light_paths=32, iterations=4)
    from warp_ir.cli.checkpoint import Checkpoint, fingerprint

    renderer = ir.Renderer(scene, settings)
    film = renderer.new_film()
    renderer.add_iteration(film, 0)
    assert Checkpoint(picture, film, lambda: fingerprint(scene, renderer.settings), 1.0).write()
    assert main(command(picture, "--resume", "--seed", "5")) == 2
    assert "remove it, or render without --resume" in capsys.readouterr().err
    assert main(command(picture, "--resume", "--iterations", "2", "-q")) == 0
    assert os.listdir(tmp_path) == ["a.npy"]


def test_a_full_disk_does_not_stop_the_render(tmp_path, capsys, monkeypatch):
    """A checkpoint that cannot be written is a warning, once; the picture is rendered."""
    from warp_ir.film.film import Film

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Film, "save", full)
    assert main(command(tmp_path / "a.npy", "--iterations", "6", "--checkpoint", "0.0001")) == 0
    captured = capsys.readouterr()
    assert captured.err.count("no checkpoint") == 1 and "no space left" in captured.err
    assert os.listdir(tmp_path) == ["a.npy"]
