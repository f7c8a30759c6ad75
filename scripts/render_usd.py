"""Renders a USD stage to a picture: a short example of the Python API.

python scripts/render_usd.py scenes_usd/cornell_box.usda cornell_box.exr --device cpu --time-limit 20
"""

import argparse
import sys

import warp_ir as ir


def main() -> None:
    parser = argparse.ArgumentParser(description="Render a USD stage to a picture.")
    parser.add_argument("stage", metavar="STAGE", help="USD file")
    parser.add_argument("output", metavar="OUTPUT", help=".exr .hdr .pfm .npy (linear), .png .jpg (tone-mapped)")
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, ... (default: cpu)")
    parser.add_argument("--camera", help="path or name of the camera (default: the stage's main camera)")
    parser.add_argument("--width", type=int, default=512, help="width in pixels (default: 512)")
    parser.add_argument("--iterations", type=int, help="stop after this number (default: 64 without a time limit)")
    parser.add_argument("--time-limit", type=float, help="stop after this number of seconds")
    args = parser.parse_args()

    scene = ir.load_usd(args.stage, camera=args.camera)
    for warning in scene.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    settings = ir.RenderSettings(width=args.width, iterations=args.iterations, time_limit=args.time_limit)
    film = ir.render(scene, settings, device=args.device)
    ir.write_image(args.output, film)
    print(f"{args.output}: {film.iterations} iterations in {film.seconds:.1f} s, error {100 * film.error():.1f} %")
    if film.interrupted:
        sys.exit(128 + film.interrupted)


if __name__ == "__main__":
    try:
        main()
    except ir.InputError as error:
        sys.exit(f"error: {error}")
