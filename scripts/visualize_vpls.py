"""Draws the virtual point lights of a USD stage bounce by bounce, and shows them in a window.

    python scripts/visualize_vpls.py scenes_usd/cornell_box.usda cloud.png --max-bounces 3
    python scripts/visualize_vpls.py scenes_usd/cornell_box.usda --paths

The first command writes cloud.0.png (VPLs on the lights), cloud.1.png (also on the first surfaces that light paths
hit), ...; the second opens a window, in which a right click on a VPL shows its numbers.
"""

import argparse
import sys
from pathlib import Path

import warp_ir as ir
from warp_ir.preview import COLORINGS, pick_vpls, picture_vpls, plotter


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the virtual point lights of a USD stage.")
    parser.add_argument("stage", metavar="STAGE", help="USD file")
    parser.add_argument("output", metavar="OUTPUT", type=Path, nargs="?", help=".png file; none: a window opens")
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, ... (default: cpu)")
    parser.add_argument("--light-paths", type=int, default=1024, help="light paths per iteration (default: 1024)")
    parser.add_argument("--max-bounces", type=int, default=3, help="maximum number of bounces (default: 3)")
    parser.add_argument("--view", choices=("camera", "outside"), default="outside", help="viewpoint (default: outside)")
    colorings = [name for name in COLORINGS if name != "contribution"]
    parser.add_argument("--color-by", choices=colorings, default="hue", help="meaning of colours (default: hue)")
    parser.add_argument("--paths", action="store_true", help="also draw the light paths")
    args = parser.parse_args()

    scene = ir.load_usd(args.stage)
    settings = ir.RenderSettings(light_paths=args.light_paths, max_bounces=args.max_bounces)
    vpls = ir.trace_vpls(scene, settings, device=args.device)
    options = {"view": args.view, "color_by": args.color_by, "paths": args.paths}
    if args.output is None:
        plot = plotter(scene, vpls, **options)
        pick_vpls(plot, vpls)
        plot.show()
        return
    for last in range(args.max_bounces + 1):
        path = args.output.with_suffix(f".{last}.png")
        picture_vpls(scene, vpls, path, bounces=range(last + 1), **options)
        print(f"{path}: {(vpls.bounce <= last).sum()} VPLs, at most {last} bounces")


if __name__ == "__main__":
    try:
        main()
    except ir.InputError as error:
        sys.exit(f"error: {error}")
