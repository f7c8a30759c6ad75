"""Interruption: what has been rendered is not lost, and to go on gives the same bits as never to have stopped."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.cli import main
from warp_ir.cli.checkpoint import Checkpoint, fingerprint
from warp_ir.files import _machine, _temporary, check_output
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


@pytest.mark.parametrize("suffix", ["npy", "png", "exr", "jpg", "tif", "hdr", "pfm"])
def test_a_resumed_animation_keeps_the_pictures_it_has(tmp_path, caplog, suffix):
    """Frames that are there are left alone; those that are not, or are damaged, are rendered."""
    stage, output = str(SCENES / "turntable.usda"), str(tmp_path / f"#.{suffix}")
    frames = ["render", stage, output, *SMALL, "--iterations", "1", "-q", "--frames"]
    assert main([*frames, "1:3"]) == 0
    first, second, third, fourth = (tmp_path / f"{number}.{suffix}" for number in range(1, 5))
    before, whole = first.stat().st_ino, read_image(second)
    second.write_bytes(b"abc")
    third.write_bytes(third.read_bytes()[: third.stat().st_size // 2])
    assert main([*frames, "1:4", "--resume"]) == 0
    assert caplog.text.count("exists and is skipped") == 1 and caplog.text.count("rendered anew") == 2
    assert first.stat().st_ino == before and fourth.exists()
    np.testing.assert_array_equal(read_image(second), whole)


@pytest.mark.parametrize("suffix", ["png", "exr", "jpg", "tif"])
def test_a_picture_of_something_else_is_not_kept(tmp_path, caplog, suffix):
    """Other settings, limits, exposure or a stage that has changed since: the picture is rendered anew."""
    stage, picture = tmp_path / "room.usda", tmp_path / f"a.{suffix}"
    stage.write_text(Path(ROOM).read_text())

    def skipped(*more):
        caplog.clear()
        flags = dict(zip(SMALL[::2], SMALL[1::2], strict=True)) | dict(zip(more[::2], more[1::2], strict=True))
        words = [word for flag in flags.items() for word in flag]
        assert main(["render", str(stage), str(picture), "--resume", "-q", *words]) == 0
        return "exists and is skipped" in caplog.text

    one = "--iterations", "1"
    assert not skipped(*one) and skipped(*one)
    for flags in ((*one, "--seed", "2"), ("--iterations", "2"), (*one, "--exposure", "1"), (*one, "--width", "17")):
        assert not skipped(*flags) and skipped(*flags) and not skipped(*one)
    stage.write_text(stage.read_text().replace("intensity = ", "intensity = 2"))
    assert not skipped(*one) and skipped(*one)


def test_a_checkpoint_of_something_else_is_refused(tmp_path, capsys):
    """Other settings, another scene: one line that says what to do; other limits are no matter."""
    picture = tmp_path / "a.npy"
    scene = ir.load_usd(ROOM)
    settings = ir.RenderSettings(width=16, light_paths=32, iterations=4)
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


def test_a_failed_checkpoint_is_tried_again(tmp_path, monkeypatch, caplog):
    """The disk is full for a while: the next checkpoint is written, and a later failure is said again."""
    scene, settings = ir.load_usd(ROOM), ir.RenderSettings(width=8, light_paths=16)
    renderer = ir.Renderer(scene, settings)
    film = renderer.new_film()
    renderer.add_iteration(film, 0)
    checkpoint = Checkpoint(tmp_path / "a.npy", film, lambda: "key", 1e-6)
    for full in (True, True, False, True):
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        if full:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        try:
            time.sleep(0.001)
            assert checkpoint.write() != full
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]
    assert caplog.text.count("no checkpoint, to be tried again") == 2


DISTURBED = """
import os, resource, shutil, sys
from pathlib import Path
from warp_ir.cli import command, render

picture, render_picture = Path(sys.argv[3]), render.ir.Renderer.render
def disturbed(*args, **kwargs):
    film = render_picture(*args, **kwargs)
    {fault}
    return film
render.ir.Renderer.render = disturbed
command()
"""
"""A `warp-ir` to which something happens once the picture has been rendered."""


def disturbed(folder, picture, fault):
    """What such a command prints to stderr, in one line."""
    (folder / "elsewhere").mkdir()
    process = [sys.executable, "-c", DISTURBED.format(fault=fault), *command(picture, "--iterations", "2")]
    env = {**os.environ, "TMPDIR": str(folder / "elsewhere")}
    done = subprocess.run([*process, "--width", "64"], capture_output=True, text=True, env=env)
    assert done.returncode == 1 and done.stdout == "" and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith(f"warp-ir: error: {picture}: ")
    return done.stderr


@pytest.mark.parametrize("suffix", ["exr", "npy", "png", "jpg", "hdr", "tif"])
def test_no_room_for_the_picture_is_one_line(tmp_path, suffix):
    """No file may grow beyond 100 bytes: one line in every format, and nothing left. libjpeg would exit."""
    said = disturbed(tmp_path, tmp_path / f"a.{suffix}", "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))")
    assert "no room for its film" in said and os.listdir(tmp_path) == ["elsewhere"]


@pytest.mark.parametrize(
    ("fault", "place"), [("picture.mkdir()", "."), ("shutil.rmtree(picture.parent)", "elsewhere/*")]
)
def test_a_picture_that_cannot_be_written_is_not_lost(tmp_path, fault, place):
    """The film is kept beside it or elsewhere, where is said, and --resume makes the picture without an iteration."""
    folder = tmp_path / "out"
    folder.mkdir()
    picture = folder / "a.npy"
    said = disturbed(tmp_path, picture, fault)
    (kept,) = (tmp_path if "*" in place else folder).glob(f"{place}/*.film.npz")
    assert f"film is kept in {kept}" in said
    folder.mkdir(exist_ok=True)
    if picture.exists():
        picture.rmdir()
    kept.rename(folder / kept.name)
    flags = ["--width", "64", "--iterations", "2"]
    assert main([*command(picture, *flags), "--resume"]) == 0
    assert main(command(tmp_path / "b.npy", *flags)) == 0
    np.testing.assert_array_equal(read_image(picture), read_image(tmp_path / "b.npy"))


def test_what_a_killed_command_leaves_is_cleared(tmp_path):
    """A file of a process that is no more is removed by the next; those of living ones and other machines stay."""
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    mine = _temporary(tmp_path / "a.npy").name
    other = mine.replace(f"-{os.getpid()}-", f"-{int(gone.stdout)}-")
    far = other.replace(_machine(), "00000000")
    for name in (mine, other, far):
        (tmp_path / name).touch()
    check_output(tmp_path / "a.npy", [".npy"])
    assert {*os.listdir(tmp_path)} == {mine, far}
