"""A room from a USD file in which two blocks move, without Newton; the picture gets better while they stand still.

    python examples/usd_room.py --out pictures

Any stage will do, with the names of the meshes that move. Poses are those of the meshes in the stage times a motion.
"""

import argparse
from pathlib import Path

import numpy as np
import warp as wp

import warp_ir as ir

SCENES = Path(__file__).parents[1] / "scenes_usd"


@wp.kernel(enable_backward=False)
def slide(time: float, rest: wp.array[wp.transformf], rows: wp.array[wp.int32], moved: wp.array[wp.transformf]):
    """Poses of the blocks at a time: each turns about its own axis and slides to and fro."""
    k = wp.tid()
    pose = rest[rows[k]]
    angle = wp.sin(time + float(k))
    turn = wp.transform(
        wp.vec3(60.0 * angle, 0.0, 40.0 * wp.cos(time)), wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.2 * angle)
    )
    moved[k] = wp.transform_multiply(turn, pose)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stage", default=str(SCENES / "cornell_box.usda"))
    parser.add_argument("--move", nargs="+", default=["/World/Box/ShortBlock", "/World/Box/TallBlock"])
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--size", type=int, default=128, help="width of the picture [pixels]")
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    scene = ir.load_usd(args.stage)
    live = ir.LiveScene(scene, device=args.device)
    views = ir.Views(live, ir.ViewSettings(accumulate="static"))
    numbers = [row for name in args.move for row in live.rows(name)]
    rows = wp.array(numbers, dtype=wp.int32, device=args.device)
    rest, moved = wp.clone(live.transforms), wp.zeros(len(numbers), dtype=wp.transformf, device=args.device)

    camera = scene.camera
    width, height = args.size, round(args.size / camera.aspect)
    left, right, bottom, top = camera.window
    rays = np.zeros((height, width, 1, 2, 3), np.float32)
    rays[..., 0, 1, 0] = left + (np.arange(width) + 0.5) / width * (right - left)
    rays[..., 0, 1, 1] = (top - (np.arange(height) + 0.5) / height * (top - bottom))[:, None]
    rays[..., 0, 1, 2] = -1.0
    bundle = wp.array(rays, dtype=wp.vec3, device=args.device)
    m = camera.world_from_camera
    turn = wp.quat_from_matrix(wp.mat33(*m[:3, :3].ravel().tolist()))
    pose = wp.array([[*m[:3, 3], *turn]], dtype=wp.transformf, device=args.device)
    image = wp.zeros((1, height, width), dtype=wp.vec3, device=args.device)

    args.out.mkdir(parents=True, exist_ok=True)
    for frame in range(args.frames):
        wp.launch(slide, dim=len(numbers), inputs=[0.8 * frame, rest, rows, moved], device=args.device)
        live.set_transforms(moved, rows)
        live.refit()
        for _ in range(16):  # the blocks stand still, and the mean goes on
            views.render(pose, bundle, hdr_color=image)
        ir.write_image(args.out / f"room_{frame:03d}.png", image.numpy()[0])


if __name__ == "__main__":
    main()
