"""A data set from many cameras: colour, depth and segmentation of a thousand worlds, in a few calls.

    python examples/dataset.py --out pictures --worlds 1000

Every world has the same bodies in other places; all worlds lie in one place and do not see each other. A call renders
as many views as are wanted; worlds are done in batches that fit into memory, which changes no bit.
"""

import argparse
from pathlib import Path

import newton
import numpy as np
import warp as wp

from warp_ir.image import write_image
from warp_ir.newton import GiSettings, SensorCamera

COLORS = ((0.9, 0.2, 0.2), (0.2, 0.7, 0.3), (0.25, 0.35, 0.9), (0.9, 0.8, 0.2))


def build(worlds: int, device: str) -> newton.Model:
    one = newton.ModelBuilder()
    for k, color in enumerate(COLORS):
        body = one.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 1.0), wp.quat_identity()))
        if k % 2:
            one.add_shape_box(body, hx=0.2, hy=0.2, hz=0.2, color=color)
        else:
            one.add_shape_sphere(body, radius=0.22, color=color)
    model = newton.ModelBuilder()
    model.replicate(one, worlds)
    model.add_ground_plane(color=(0.75, 0.75, 0.75))
    return model.finalize(device=device)


@wp.kernel(enable_backward=False)
def scatter(seed: int, body_q: wp.array[wp.transformf], cameras: wp.array[wp.transformf], bodies: int):
    """Puts the bodies of a world somewhere, and its camera on a circle around them."""
    world = wp.tid()
    rng = wp.rand_init(seed, world)
    for k in range(bodies):
        place = wp.vec3(wp.randf(rng, -0.8, 0.8), wp.randf(rng, -0.8, 0.8), wp.randf(rng, 0.22, 0.8))
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), wp.randf(rng, 0.0, 6.28))
        body_q[bodies * world + k] = wp.transform(place, turn)
    around = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), wp.randf(rng, 0.0, 6.28))
    down = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 1.15)
    cameras[world] = wp.transform(wp.quat_rotate(around, wp.vec3(0.0, -3.0, 1.7)), around * down)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--worlds", type=int, default=1000)
    parser.add_argument("--size", type=int, default=32, help="width and height of a picture [pixels]")
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    model = build(args.worlds, args.device)
    state = model.state()
    camera = SensorCamera(model, gi=GiSettings(light_paths=256))
    camera.create_default_light()
    poses = wp.zeros(args.worlds, dtype=wp.transformf, device=args.device)
    rays = SensorCamera.compute_camera_rays_pinhole(args.size, args.size, camera_fov=0.8, device=args.device)
    shape = (args.worlds, args.size, args.size)
    color, depth = camera.allocate_image_color_hdr(*shape), camera.allocate_image_depth(*shape)
    index = camera.allocate_image_shape_index(*shape)
    wp.launch(scatter, dim=args.worlds, inputs=[7, state.body_q, poses, len(COLORS)], device=args.device)
    camera.update(state, poses, rays, hdr_color_image=color, depth_image=depth, shape_index_image=index)

    args.out.mkdir(parents=True, exist_ok=True)
    segments = np.minimum(index.numpy(), model.shape_count).astype(np.int64)  # the last one: nothing
    np.savez_compressed(args.out / "dataset.npz", color=color.numpy(), depth=depth.numpy(), segments=segments)
    shown = min(args.worlds, 64)
    palette = np.random.default_rng(0).uniform(0.1, 1.0, (model.shape_count + 1, 3)).astype(np.float32)
    near = np.clip(1.0 - depth.numpy()[:shown, :, :, None].repeat(3, axis=3) / 6.0, 0.0, 1.0)
    rows = [sheet(x) for x in (color.numpy()[:shown], near.astype(np.float32), palette[segments[:shown]])]
    write_image(args.out / "dataset.png", np.concatenate(rows, axis=1))


def sheet(images: np.ndarray) -> np.ndarray:
    """Images [n, rows, columns, 3] in a square."""
    side = int(np.sqrt(len(images)))
    return np.concatenate([np.concatenate(list(images[side * k : side * (k + 1)]), axis=1) for k in range(side)])


if __name__ == "__main__":
    main()
