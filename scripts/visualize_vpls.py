"""Draws the virtual point lights of a USD stage, one picture for each maximum length of the light paths.

    python scripts/visualize_vpls.py scenes_usd/cornell_box.usda cloud.png --max-bounces 3

writes cloud.0.png (VPLs on the lights), cloud.1.png (also on the first surfaces that light paths hit), ...
"""

import argparse
import sys
from pathlib import Path

import warp_ir as ir
from warp_ir.preview import picture_vpls


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the virtual point lights of a USD stage.")
    parser.add_argument("stage", metavar="STAGE", help="USD file")
    parser.add_argument(
        "output", metavar="OUTPUT", type=Path, help=".png file; the number of bounces is added to its name"
    )
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, ... (default: cpu)")
    parser.add_argument("--light-paths", type=int, default=1024, help="light paths per iteration (default: 1024)")
    parser.add_argument(
        "--max-bounces", type=int, default=3, help="maximum number of bounces in the last picture (default: 3)"
    )
    parser.add_argument("--view", choices=("camera", "outside"), default="outside", help="viewpoint (default: outside)")
    args = parser.parse_args()

    scene = ir.load_usd(args.stage)
    for bounces in range(args.max_bounces + 1):
        settings = ir.RenderSettings(light_paths=args.light_paths, max_bounces=bounces)
        vpls = ir.trace_vpls(scene, settings, device=args.device)
        path = args.output.with_suffix(f".{bounces}.png")
        picture_vpls(scene, vpls, path, view=args.view)
        print(f"{path}: {len(vpls.positions)} VPLs, at most {bounces} bounces")


if __name__ == "__main__":
    try:
        main()
    except ir.InputError as error:
        sys.exit(f"error: {error}")
