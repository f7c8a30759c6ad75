"""Makes every picture of the README and of the pages in docs/, with the extra `docs`.

    python scripts/make_gallery.py docs/pictures --device cpu
    python scripts/make_gallery.py docs/pictures -k series

The second command makes only the pictures whose name contains the text. All take some ten minutes on two cores.
"""

import argparse
import math
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib
import numpy as np

import warp_ir as ir
from warp_ir.image.tonemap import tone_map
from warp_ir.metrics import relative_mse
from warp_ir.preview import picture_vpls

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.ticker import LogLocator, NullLocator

SCENES = Path(__file__).parent.parent / "scenes_usd"
DPI, LABEL, GAP = 100, 22, 6
"""Pixels per inch, and the heights of a label and of a gap between panels [pixels]."""
Panel = tuple[str, np.ndarray]
"""The label of a panel, and its display values in [0, 1], [h, w, 3]."""


class Gallery:
    """Where pictures are rendered, and with which fraction of the iterations."""

    def __init__(self, device: str, quality: float) -> None:
        self.device = device
        self.quality = quality

    def film(self, scene: str, iterations: int, **settings: Any) -> ir.Film:
        """The film of a scene after a number of iterations."""
        wanted = ir.RenderSettings(iterations=max(1, round(self.quality * iterations)), **settings)
        film = ir.render(ir.load_usd(SCENES / f"{scene}.usda"), wanted, device=self.device)
        if film.interrupted:
            sys.exit("interrupted")
        return film

    def radiance(self, scene: str, iterations: int, **settings: Any) -> np.ndarray:
        """The picture of a scene, linear [h, w, 3]."""
        return self.film(scene, iterations, **settings).radiance()

    def vpls(self, name: str, contribution_to: Any = None, **settings: Any) -> tuple[ir.Scene, Any]:
        """A scene and the VPLs of its first iteration."""
        scene = ir.load_usd(SCENES / f"{name}.usda")
        wanted = ir.RenderSettings(**settings)
        return scene, ir.trace_vpls(scene, wanted, device=self.device, contribution_to=contribution_to)


def write_panels(path: Path, rows: Sequence[Sequence[Panel]]) -> None:
    """Writes panels of the same size in rows, each below its label, pixel by pixel."""
    height, width = rows[0][0][1].shape[:2]
    columns = max(len(row) for row in rows)
    size = columns * (width + GAP) - GAP, len(rows) * (height + LABEL + GAP) - GAP
    figure = pyplot.figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI, facecolor="white")
    for j, row in enumerate(rows):
        for i, (label, values) in enumerate(row):
            left, top = i * (width + GAP), j * (height + LABEL + GAP) + LABEL
            box = left / size[0], 1.0 - (top + height) / size[1], width / size[0], height / size[1]
            axes = figure.add_axes(box)
            axes.imshow(np.clip(values, 0.0, 1.0), interpolation="none", aspect="auto")
            axes.set_axis_off()
            figure.text(box[0], box[1] + box[3] + 5 / size[1], label, fontsize=9, va="bottom")
    figure.savefig(path, dpi=DPI, pil_kwargs={"quality": 85, "method": 6})
    pyplot.close(figure)


def drawing(scene: ir.Scene, vpls: Any, **options: Any) -> np.ndarray:
    """A drawing of VPLs in their scene as an array, every pixel the mean of four."""
    with TemporaryDirectory() as folder:
        path = picture_vpls(scene, vpls, Path(folder) / "cloud.png", width=768, height=576, **options)
        large = ir.read_image(path)[..., :3]
    return large.reshape(288, 2, 384, 2, 3).mean(axis=(1, 3))


def render(scene: str, iterations: int, **settings: Any) -> Callable[[Gallery, Path], None]:
    """What writes a rendered picture of a scene."""
    return lambda gallery, path: ir.write_image(path, gallery.film(scene, iterations, **settings)) and None


def make_vpls(gallery: Gallery, path: Path) -> None:
    """The VPLs of one iteration, seen from outside."""
    picture_vpls(*gallery.vpls("two_rooms"), path, width=512)


def make_series(gallery: Gallery, path: Path) -> None:
    """The terms of the Neumann series, and their sums."""
    settings: dict[str, Any] = {"width": 192, "visible_lights": True}
    limits = 0, 1, 2, None
    sums = [gallery.radiance("cornell_box", 96, max_bounces=limit, **settings) for limit in limits]
    terms = [sums[0], *np.diff(sums, axis=0)]
    names = ("direct light", 0), ("one bounce, × 2", 1), ("two bounces, × 4", 2), ("three and more, × 4", 2)
    first = [(name, tone_map(term, stops)) for (name, stops), term in zip(names, terms, strict=True)]
    labels = "direct light", "… plus one bounce", "… plus two bounces", "all bounces"
    second = [(label, tone_map(total)) for label, total in zip(labels, sums, strict=True)]
    write_panels(path, [first, second])


def make_sets(gallery: Gallery, path: Path) -> None:
    """The VPLs of one iteration of `keller`, and the mean of many iterations."""
    panels = []
    for iterations in (1, 4, 16, 128):
        picture = gallery.radiance(
            "cornell_box", iterations, width=192, estimator="keller", light_paths=16, visible_lights=True
        )
        panels.append((f"{iterations} iteration{'s' * (iterations > 1)}", tone_map(picture)))
    write_panels(path, [panels])


def make_bound(gallery: Gallery, path: Path) -> None:
    """What near VPLs do to a corner, by each way of treating them."""
    # The corner of the floor beside the tall box.
    settings: dict[str, Any] = {"width": 448, "height": 448, "data_window": (0.0, 0.0, 192 / 448, 192 / 448)}
    few: dict[str, Any] = {"estimator": "keller", "light_paths": 32, **settings}
    panels = [
        ("keller: bright dots", gallery.radiance("cornell_box", 12, **few)),
        ("keller, bounded: too dark", gallery.radiance("cornell_box", 12, bound_radius=0.15, **few)),
        ("vpl: bounded, compensated", gallery.radiance("cornell_box", 48, **settings)),
        ("path: the reference", gallery.radiance("cornell_box", 384, estimator="path", **settings)),
    ]
    write_panels(path, [[(label, tone_map(picture, 0.5)) for label, picture in panels]])


def make_filter(gallery: Gallery, path: Path) -> None:
    """A few iterations without and with the filter, beside many."""
    settings: dict[str, Any] = {"width": 256}
    panels = [
        ("4 iterations, no filter", gallery.radiance("two_rooms", 4, filter=False, **settings)),
        ("4 iterations, filtered", gallery.radiance("two_rooms", 4, **settings)),
        ("512 iterations, no filter", gallery.radiance("two_rooms", 512, filter=False, **settings)),
    ]
    write_panels(path, [[(label, tone_map(picture)) for label, picture in panels]])


def make_clouds(gallery: Gallery, path: Path) -> None:
    """VPLs by bounce, the light paths between them, and those that light one pixel."""
    scene, vpls = gallery.vpls("cornell_box", light_paths=512, max_bounces=3)
    few = gallery.vpls("cornell_box", light_paths=24)[1]
    # A pixel of the back wall, from which the tall box hides some VPLs.
    pixel = gallery.vpls("cornell_box", (45, 110), light_paths=32, width=192)[1]
    rows = [
        [
            ("VPLs by bounce", drawing(scene, vpls, color_by="bounce")),
            ("VPLs by flux", drawing(scene, vpls, color_by="flux")),
        ],
        [
            ("24 light paths", drawing(scene, few, paths=True)),
            ("what one pixel receives from each", drawing(scene, pixel, paths=True, color_by="contribution")),
        ],
    ]
    write_panels(path, rows)


def make_aovs(gallery: Gallery, path: Path) -> None:
    """The AOVs of a film."""
    film = gallery.film("two_rooms", 128, width=224)
    depth = film.aov("depth")[..., None].repeat(3, axis=-1)
    rows = [
        [
            ("radiance", tone_map(film.radiance())),
            ("direct", tone_map(film.aov("direct"))),
            ("indirect", tone_map(film.aov("indirect"))),
        ],
        [
            ("albedo", tone_map(film.aov("albedo"))),
            ("normal (n + 1) / 2", 0.5 * film.aov("normal") + 0.5),
            ("depth / greatest depth", depth / depth.max()),
        ],
    ]
    write_panels(path, rows)


def make_error(gallery: Gallery, path: Path) -> None:
    """The error of each method against time, medians of three seeds."""
    methods: dict[str, dict[str, Any]] = {
        "vpl": {},
        "vpl without filter": {"filter": False},
        "keller": {"estimator": "keller"},
        "path": {"estimator": "path"},
    }
    # What other programs do changes the wall time, but hardly the CPU time.
    on_cpu = gallery.device == "cpu"
    clock = time.process_time if on_cpu else time.perf_counter
    limit = 4.0 * gallery.quality
    scene = ir.load_usd(SCENES / "cornell_box.usda")
    reference = gallery.film("cornell_box", 4096, width=96, estimator="path", seed=1000)
    noise, smooth = reference.standard_error(), gallery.radiance("cornell_box", 64, width=96)
    figure, axes = pyplot.subplots(figsize=(6.4, 4.2), dpi=DPI, layout="constrained")
    for name, choices in methods.items():
        curves = []
        for seed in range(3):
            renderer = ir.Renderer(scene, ir.RenderSettings(width=96, seed=seed, **choices), device=gallery.device)
            renderer.add_iteration(renderer.new_film(), 0)  # compiles, and learns guides
            film, seconds, curve = renderer.new_film(), 0.0, []
            while seconds < limit:
                begin = clock()
                for iteration in range(film.iterations, max(1, 2 * film.iterations)):
                    renderer.add_iteration(film, iteration)
                seconds += clock() - begin
                begin = clock()
                picture = film.radiance()
                after = seconds + clock() - begin  # a picture is made once, at the end
                error = relative_mse(picture, reference.radiance(), reference_error=noise, scale=smooth)
                curve.append((after, math.sqrt(max(error, 0.0))))
            curves.append(curve)
        # Seeds can need other numbers of iterations to the limit.
        shortest = min(map(len, curves))
        x, y = np.median([curve[:shortest] for curve in curves], axis=0).T
        axes.loglog(x, 100.0 * y, marker="o", markersize=4, label=name)
    axes.set_xlabel("CPU time [s]" if on_cpu else "time [s]")
    axes.set_ylabel("relative RMS error [%]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    axes.grid(alpha=0.4)
    axes.legend()
    figure.savefig(path, dpi=DPI, pil_kwargs={"quality": 85, "method": 6})
    pyplot.close(figure)


def make_simulation(gallery: Gallery, path: Path) -> None:
    """Bodies that fall, by Newton's sensor and with bounced light: the example, which needs the extra `newton`."""
    from warp_ir.image.io import read_image

    example = Path(__file__).parent.parent / "examples" / "falling_bodies.py"
    with TemporaryDirectory() as folder:
        size, frames = str(max(32, round(320 * gallery.quality))), "5"
        command = [sys.executable, str(example), "--out", folder, "--size", size, "--frames", frames]
        subprocess.run([*command, "--device", gallery.device], check=True)
        last = read_image(Path(folder) / "falling_004.png")  # display values
    half = last.shape[1] // 2
    write_panels(path, [[("Newton's sensor", last[:, :half]), ("with global illumination", last[:, half:])]])


PICTURES: dict[str, Callable[[Gallery, Path], None]] = {
    "cornell_box.png": render("cornell_box", 256, visible_lights=True),
    "crowded_room.jpg": render("crowded_room", 48),
    "two_rooms.jpg": render("two_rooms", 128),
    "light_types.jpg": render("light_types", 128, visible_lights=True),
    "thousand_lights.jpg": render("thousand_lights", 64, visible_lights=True),
    "vpls.png": make_vpls,
    "series.webp": make_series,
    "sets.webp": make_sets,
    "bound.webp": make_bound,
    "filter.webp": make_filter,
    "clouds.webp": make_clouds,
    "aovs.webp": make_aovs,
    "error.webp": make_error,
    "simulation.webp": make_simulation,
}
"""File name, and what writes the file."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the pictures of the README and of the pages in docs/.")
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder to write to")
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, ... (default: cpu)")
    parser.add_argument("-k", dest="name", default="", metavar="TEXT", help="only files whose name contains this")
    fraction = "fraction of the iterations, for a quick look (default: 1)"
    parser.add_argument("--quality", type=float, default=1.0, metavar="X", help=fraction)
    args = parser.parse_args()

    gallery = Gallery(args.device, args.quality)
    for name, make in PICTURES.items():
        if args.name in name:
            begin = time.perf_counter()
            make(gallery, args.folder / name)
            print(f"{args.folder / name}: {time.perf_counter() - begin:.1f} s", flush=True)


if __name__ == "__main__":
    try:
        main()
    except ir.InputError as error:
        sys.exit(f"error: {error}")
