"""A picture in parts: `render --part K/N` and `merge` make what one render makes, whoever made which part and when."""

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.cli import main
from warp_ir.cli.parts import Part
from warp_ir.film import read_state
from warp_ir.image.io import read_image

SCENES = Path(__file__).parent.parent / "scenes_usd"
ROOM = str(SCENES / "two_rooms.usda")
AOVS = "", ".depth", ".alpha"
SMALL = ["--width", "24", "--light-paths", "64", "--iterations", "7", "--device", "cpu", "-q"]


@pytest.mark.parametrize(("parts", "total"), [(1, 1), (1, 7), (3, 7), (7, 7), (5, 64), (1000, 12345), (3, 2**31 - 1)])
def test_parts_are_the_whole(parts, total):
    """Every iteration is in one part, in order, and no part has more than one more than another."""
    ranges = [Part(number, parts, total).iterations for number in range(1, parts + 1)]
    assert ranges[0].start == 0 and ranges[-1].stop == total
    assert all(one.stop == other.start for one, other in itertools.pairwise(ranges))
    lengths = {len(each) for each in ranges}
    assert min(lengths) >= 1 and max(lengths) - min(lengths) <= 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--part", "0/3"], "must be K/N with K from 1 to N"),
        (["--part", "4/3"], "must be K/N"),
        (["--part", "1"], "must be K/N"),
        (["--part", "1/3", "--time-limit", "1"], "--part: is a share of --iterations"),
        (["--part", "1/3", "--iterations", "9", "--target-error", "1"], "--part: is a share of --iterations"),
        (["--part", "1/65"], "--part: 65 parts of 64 iterations"),
    ],
)
def test_parts_that_cannot_be(capsys, words, message):
    """A part is one of at most as many as there are iterations, whose number is fixed."""
    assert main(["render", ROOM, "a.npy", *words]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


def film_of(picture):
    return picture.with_name(picture.name + ".film.npz")


def render_parts(folder, *words, stage=ROOM, parts=3):
    """Renders all parts, the last one first, and returns their films in order."""
    films = []
    for number in range(parts, 0, -1):
        picture = folder / f"{number}.npy"
        assert main(["render", stage, str(picture), *SMALL, *words, "--part", f"{number}/{parts}"]) == 0
        films.insert(0, film_of(picture))
    return films


def merge(films, output, *words):
    return main(["merge", *map(str, films), str(output), "-q", *words])


@pytest.mark.extended
@pytest.mark.parametrize(
    ("stage", "words"),
    [
        (ROOM, []),
        (ROOM, ["--no-filter"]),
        (ROOM, ["--estimator", "path"]),
        (ROOM, ["--estimator", "keller"]),
        (str(SCENES / "cornell_box.usda"), ["--visible-lights", "--data-window", "0.1", "0.2", "0.9", "1"]),
        (str(SCENES / "turntable.usda"), ["--time", "3"]),
    ],
)
def test_merged_parts_are_the_picture(tmp_path, stage, words):
    """A merged picture has the same bits in any order of its films, and up to rounding those of one render."""
    films = render_parts(tmp_path, *words, stage=stage)
    whole = tmp_path / "whole.npy"
    assert main(["render", stage, str(whole), *SMALL, *words, "--aov", "depth", "alpha"]) == 0
    pictures = []
    for order in ([0, 1, 2], [2, 0, 1]):
        assert merge([films[k] for k in order], tmp_path / "merged.npy", "--aov", "depth", "alpha") == 0
        pictures.append([read_image(tmp_path / f"merged{aov}.npy") for aov in AOVS])
    for one, other, aov in zip(*pictures, AOVS, strict=True):
        np.testing.assert_array_equal(one, other)
        wanted = read_image(tmp_path / f"whole{aov}.npy")
        # Sums of float32 in another order; weights of the filter multiply the difference by some tens.
        np.testing.assert_allclose(one, wanted, rtol=1e-4, atol=1e-5 * wanted.mean())
    assert {*os.listdir(tmp_path)} == {
        *(film.name for film in films), *(f"{picture}{aov}.npy" for picture in ("whole", "merged") for aov in AOVS)
    }  # fmt: skip


@pytest.mark.extended
def test_merge_writes_as_render_does(tmp_path):
    """What the parts were given counts, and what merge is given wins: layers, exposure, where the stage is now."""
    stage = tmp_path / "room.usda"
    stage.write_text(Path(ROOM).read_text())
    films = render_parts(tmp_path, "--aov", "normal", "--float", "--exposure", "3", stage=str(stage))
    assert main(["render", str(stage), str(tmp_path / "whole.png"), *SMALL, "--exposure", "3"]) == 0
    stage.rename(tmp_path / "moved.usda")
    assert merge(films, tmp_path / "a.exr") == 2
    moved = ["--stage", str(tmp_path / "moved.usda"), "--stats", str(tmp_path / "stats.json")]
    assert merge(films, tmp_path / "a.exr", *moved) == 0 and merge(films, tmp_path / "a.png", *moved) == 0
    assert read_image(tmp_path / "a.exr", "normal").shape == (18, 24, 3)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), read_image(tmp_path / "whole.png"), atol=1.01 / 255)
    stats = json.loads((tmp_path / "stats.json").read_text())
    assert stats["iterations"] == 7 and stats["settings"]["iterations"] == 7
    assert merge(films, tmp_path / "b.png", *moved, "--exposure", "0") == 0
    assert read_image(tmp_path / "b.png").mean() < read_image(tmp_path / "a.png").mean()


@pytest.mark.extended
def test_films_that_make_up_no_picture(tmp_path, capsys):
    """Films of other scenes, settings or numbers, doubled, missing, unfinished, of no part: one line names the film."""
    (tmp_path / "other").mkdir()
    films, fewer = render_parts(tmp_path), render_parts(tmp_path / "other", "--seed", "2")
    halves = tmp_path / "h.npy"
    assert main(["render", ROOM, str(halves), *SMALL, "--part", "1/2"]) == 0
    ir.render(ir.load_usd(ROOM), ir.RenderSettings(width=8, light_paths=8, iterations=1)).save(tmp_path / "plain.npz")
    unfinished = tmp_path / "unfinished.npz"
    with np.load(films[2]) as file:
        arrays = dict(file)
    renderer = ir.Renderer(ir.load_usd(ROOM), ir.RenderSettings(width=24, light_paths=64))
    film = renderer.new_film()
    renderer.add_iteration(film, 4)
    film.save(unfinished, str(arrays["key"]), str(arrays["note"]))
    output = tmp_path / "a.npy"
    capsys.readouterr()
    for given, message in (
        (films[:2], "is part 1/3; missing: 3"),
        ([films[0], films[2]], "is part 1/3; missing: 2"),
        ([*films, films[1]], "are both part 2/3"),
        ([films[0], films[1], fewer[2]], r"3.npy.film.npz: is of another scene, other settings"),
        ([films[0], film_of(halves)], "is part 1/2 of 7 iterations, and"),
        ([films[0], films[1], unfinished], "unfinished.npz: has 1 of 3 iterations; warp-ir render --resume --part"),
        ([films[0], tmp_path / "plain.npz"], "plain.npz: is no part of a picture"),
        ([films[0], tmp_path / "gone.npz"], "gone.npz: no such file"),
    ):
        assert merge(given, output) == 2
        said = capsys.readouterr().err
        assert message in said and said.count("\n") == 1
    assert merge(films, output, "--stage", str(SCENES / "cornell_box.usda")) == 2
    assert "another scene, or with other settings" in capsys.readouterr().err
    assert merge(films, tmp_path) == 2 and merge(films, tmp_path / "a.unknown") == 2
    assert not output.exists()


@pytest.mark.extended
def test_a_part_goes_on_where_it_was_stopped(tmp_path, capsys, caplog):
    """A resumed part has the bits of one go, a finished one is skipped, and none takes the place of another film."""
    (film, *_), whole = render_parts(tmp_path, parts=1), (tmp_path / "whole.npy")
    (tmp_path / "a").mkdir()
    films = render_parts(tmp_path / "a", parts=2)
    before = {path: dict(np.load(path)) for path in films}
    # What is left of the second part after two of its iterations.
    renderer = ir.Renderer(ir.load_usd(ROOM), ir.RenderSettings(width=24, light_paths=64))
    begun = renderer.new_film()
    for iteration in (3, 4):
        renderer.add_iteration(begun, iteration)
    begun.save(films[1], str(before[films[1]]["key"]), str(before[films[1]]["note"]))
    words = ["render", ROOM, str(tmp_path / "a" / "2.npy"), *SMALL]
    assert main([*words, "--part", "2/2", "--resume"]) == 0 and read_state(films[1]).iterations == 4
    with np.load(films[1]) as file:
        for name in ("direct", "indirect", "count", "standard_deviation", "reconstruction_direct"):
            np.testing.assert_array_equal(file[name], before[films[1]][name])
    assert main([*words, "--part", "2/2", "--resume"]) == 0 and "exists and is skipped" in caplog.text
    capsys.readouterr()
    for more in (["--part", "1/2"], ["--part", "2/2", "--iterations", "8"], ["--resume"], []):
        assert main([*words, *more]) == 2
        assert "2.npy.film.npz: holds part 2/2 of 7 iterations" in capsys.readouterr().err
    # A picture may take the name that a part was given: its film stays.
    assert merge(films, tmp_path / "a" / "2.npy") == 0 and all(path.exists() for path in films)
    assert merge([film], whole) == 0 and merge(films, tmp_path / "halves.npy") == 0
    one, other = read_image(whole), read_image(tmp_path / "halves.npy")
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * one.mean())


@pytest.mark.extended
def test_a_part_that_is_interrupted_is_saved(tmp_path):
    """Ctrl-C leaves the iterations that are done in the film, even without checkpoints, and 130."""
    picture = tmp_path / "a.npy"
    words = ["render", ROOM, str(picture), *SMALL[:4], "--iterations", "1000000", "--checkpoint", "0", "--part", "2/2"]
    python = "from warp_ir.cli import render, command; import os, signal, sys\n"
    python += "class Display(render.ProgressDisplay):\n    def __call__(self, progress):\n"
    python += "        progress.iterations == 3 and os.kill(os.getpid(), signal.SIGINT)\n"
    python += "render.ProgressDisplay = Display\ncommand()"
    done = subprocess.run([sys.executable, "-c", python, *words], capture_output=True, text=True)
    assert done.returncode == 130 and "--resume continues from this checkpoint" in done.stderr, done.stderr
    assert os.listdir(tmp_path) == ["a.npy.film.npz"]
    state = read_state(film_of(picture))
    assert 3 <= state.iterations < 100 and json.loads(state.note)["part"] == 2


@pytest.mark.extended
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"preset": {"log-file": "owned"}}, "'log-file' is no flag that a picture depends on"),
        ({"preset": {"stats": "owned.json"}}, "'stats' is no flag"),
        ({"preset": {"width": [1, 2]}}, "film.npz: argument --width/-w: invalid int value"),
        ({"preset": {"width": {"a": 1}}}, "must be a number, a text or a list"),
        ({"preset": {"width": 25}}, "another scene, or with other settings"),
        ({"preset": []}, "its flags are none"),
        ({"stage": 3}, "its stage is no text"),
        ({"stage": "/dev/zero"}, "is a device"),
        ({"product": "/Render/Gone"}, "its RenderProduct /Render/Gone is no longer there"),
        ({"part": 0}, "its numbers cannot be"),
        ({"part": True, "parts": 1.0}, "its numbers cannot be"),
        ({"parts": 2**40}, "its numbers cannot be"),
        ({"total": 0}, "its numbers cannot be"),
        ({"total": 3}, "it has 7 iterations, and part 1/1 has 3"),
        (None, "what it says of itself is damaged"),
    ],
)
def test_what_a_film_says_of_itself_is_not_trusted(tmp_path, capsys, monkeypatch, change, message):
    """Flags that write elsewhere, values that are none, parts that cannot be: one line, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    (film,) = render_parts(tmp_path, parts=1)
    with np.load(film) as file:
        arrays = dict(file)
    note = json.loads(str(arrays["note"]))
    arrays["note"] = np.array("[" * 100_000 if change is None else json.dumps(note | change))
    np.savez(film, **arrays)
    before = sorted(os.listdir(tmp_path))
    assert merge([film], tmp_path / "a.npy") == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1, said
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.extended
def test_frames_in_parts(tmp_path):
    """Every frame has its films, and knows its time."""
    stage, frames = str(SCENES / "turntable.usda"), ["--frames", "2:3"]
    for number in (1, 2):
        words = [str(tmp_path / f"part{number}.#.npy"), *SMALL, *frames, "--part", f"{number}/2"]
        assert main(["render", stage, *words]) == 0
    assert main(["render", stage, str(tmp_path / "whole.#.npy"), *SMALL, *frames]) == 0
    for frame in (2, 3):
        films = [film_of(tmp_path / f"part{number}.{frame}.npy") for number in (1, 2)]
        assert merge(films, tmp_path / "merged.npy") == 0
        wanted = read_image(tmp_path / f"whole.{frame}.npy")
        np.testing.assert_allclose(read_image(tmp_path / "merged.npy"), wanted, rtol=1e-4, atol=1e-5 * wanted.mean())
