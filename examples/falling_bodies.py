"""Bodies that fall, seen by Newton's own sensor (left) and with global illumination (right).

    python examples/falling_bodies.py --out pictures --frames 8

One import differs between the two cameras. On the right light comes off the walls and the ground as well.
"""

import argparse
from pathlib import Path

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera as NewtonCamera

from warp_ir.image import write_image
from warp_ir.newton import GiSettings, SensorCamera


def build(device: str) -> newton.Model:
    """A dozen bodies between two coloured walls."""
    builder = newton.ModelBuilder()
    rng = np.random.default_rng(3)
    for k in range(12):
        turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(*rng.normal(size=3))), float(rng.uniform(0.0, 3.0)))
        place = wp.vec3(*(rng.uniform(-0.7, 0.7, 2)).tolist(), 0.6 + 0.35 * k)
        body = builder.add_body(xform=wp.transform(place, turn))
        color = tuple(rng.uniform(0.3, 0.95, 3).tolist())
        if k % 3 == 0:
            builder.add_shape_sphere(body, radius=0.22, color=color)
        elif k % 3 == 1:
            builder.add_shape_box(body, hx=0.2, hy=0.2, hz=0.2, color=color)
        else:
            builder.add_shape_capsule(body, radius=0.13, half_height=0.2, color=color)
    for x, color in ((-1.4, (0.9, 0.2, 0.15)), (1.4, (0.2, 0.75, 0.25))):
        wall = wp.transform(wp.vec3(x, 0.0, 1.0), wp.quat_identity())
        builder.add_shape_box(-1, xform=wall, hx=0.05, hy=1.4, hz=1.0, color=color)
    builder.add_ground_plane(color=(0.8, 0.8, 0.8))
    return builder.finalize(device=device)


def look_at(eye: list[float], target: list[float]) -> list[float]:
    """The transform of a camera with +Z up."""
    z = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    q = wp.quat_from_matrix(wp.mat33(*np.stack([x, np.cross(z, x), z], axis=1).ravel().tolist()))
    return [*eye, *q]


def unpacked(image: wp.array) -> np.ndarray:
    """A packed image as linear colours [rows, columns, 3]."""
    packed = image.numpy()[0]
    srgb = np.stack([packed >> shift & 255 for shift in (0, 8, 16)], axis=2) / 255.0
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", type=int, default=256, help="width and height of a picture [pixels]")
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    model = build(args.device)
    state, after = model.state(), model.state()
    solver, control = newton.solvers.SolverXPBD(model), model.control()
    collisions = newton.CollisionPipeline(model)
    contacts = collisions.contacts()

    poses = wp.array([look_at([0.0, -5.0, 2.2], [0.0, 0.0, 0.8])], dtype=wp.transformf, device=args.device)
    rays = SensorCamera.compute_camera_rays_pinhole(args.size, args.size, camera_fov=0.6, device=args.device)
    config = NewtonCamera.RenderConfig(enable_shadows=True)
    cameras = [NewtonCamera(model), SensorCamera(model, gi=GiSettings(iterations=4))]
    for camera in cameras:
        camera.create_default_light(direction=wp.normalize(wp.vec3(-0.3, 0.6, -1.0)))
    image = cameras[0].allocate_image_color(1, args.size, args.size)

    args.out.mkdir(parents=True, exist_ok=True)
    for frame in range(args.frames):
        pictures = []
        for camera in cameras:
            model.bvh_refit_shapes(state)  # which Newton's sensor needs
            camera.update(state, poses, rays, color_image=image, render_config=config)
            pictures.append(unpacked(image))
        write_image(args.out / f"falling_{frame:03d}.png", np.concatenate(pictures, axis=1))
        for _ in range(60):
            state.clear_forces()
            collisions.collide(state, contacts)
            solver.step(state, after, control, contacts, 1.0 / 600.0)
            state, after = after, state


if __name__ == "__main__":
    main()
