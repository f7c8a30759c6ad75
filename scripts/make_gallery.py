"""Renders the pictures of the README.

python scripts/make_gallery.py docs --device cpu
"""

import argparse
import sys
from pathlib import Path

import warp_ir as ir
from warp_ir.preview import picture_vpls

SCENES = Path(__file__).parent.parent / "scenes_usd"
PICTURES = {
    "cornell_box.png": {"iterations": 256, "visible_lights": True},
    "crowded_room.jpg": {"iterations": 48},
    "two_rooms.jpg": {"iterations": 128},
    "light_types.jpg": {"iterations": 128, "visible_lights": True},
    "thousand_lights.jpg": {"iterations": 64, "visible_lights": True},
}
"""File name, whose stem is the name of the scene, and its render settings."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Render the pictures of the README.")
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder to write to")
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, ... (default: cpu)")
    parser.add_argument("-k", dest="name", default="", metavar="TEXT", help="only files whose name contains this")
    args = parser.parse_args()

    for name, choices in PICTURES.items():
        if args.name in name:
            path = args.folder / name
            film = ir.render(
                ir.load_usd(SCENES / f"{path.stem}.usda"), ir.RenderSettings(**choices), device=args.device
            )
            if film.interrupted:
                sys.exit("interrupted")
            ir.write_image(path, film)
            print(f"{path}: {film.iterations} iterations in {film.seconds:.1f} s", flush=True)
    if args.name in "vpls.png":
        scene = ir.load_usd(SCENES / "two_rooms.usda")
        vpls = ir.trace_vpls(scene, device=args.device)
        path = picture_vpls(scene, vpls, args.folder / "vpls.png", width=512)
        print(f"{path}: {len(vpls.positions)} VPLs")


if __name__ == "__main__":
    try:
        main()
    except ir.InputError as error:
        sys.exit(f"error: {error}")
