"""A cloth that falls over a ball: its points come from the particles of the simulation, on the device.

python examples/cloth.py --out pictures --frames 6
"""

import argparse
from pathlib import Path

import newton
import numpy as np
import warp as wp

from warp_ir.image import write_image
from warp_ir.newton import GiSettings, SensorCamera


def build(device: str) -> newton.Model:
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(-1, xform=wp.transform(wp.vec3(0.0, 0.0, 0.5), wp.quat_identity()), radius=0.4)
    builder.add_cloth_grid(
        pos=wp.vec3(-0.7, -0.7, 1.05),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0),
        dim_x=28,
        dim_y=28,
        cell_x=0.05,
        cell_y=0.05,
        mass=0.02,
        tri_ke=1.0e3,
        tri_ka=1.0e3,
        tri_kd=1.0e-4,
        edge_ke=1.0,
        particle_radius=0.03,
        color=(0.85, 0.25, 0.2),
    )
    builder.add_ground_plane(color=(0.8, 0.8, 0.75))
    builder.color()
    model = builder.finalize(device=device)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 1.0e3, 1.0e-4, 0.5
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--size", type=int, default=256, help="width and height of a picture [pixels]")
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    model = build(args.device)
    state, after = model.state(), model.state()
    solver, control = newton.solvers.SolverVBD(model, iterations=6), model.control()
    collisions = newton.CollisionPipeline(model)
    contacts = collisions.contacts()

    # Light never passes a surface; camera rays pass back faces unless told not to.
    config = SensorCamera.RenderConfig(enable_backface_culling=False)
    camera = SensorCamera(model, default_render_config=config, gi=GiSettings(iterations=4))
    camera.create_default_light(direction=wp.normalize(wp.vec3(-0.5, 0.5, -1.0)))
    pose = wp.transform(wp.vec3(0.0, -2.6, 1.5), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 1.2))
    poses = wp.array([pose], dtype=wp.transformf, device=args.device)
    rays = SensorCamera.compute_camera_rays_pinhole(args.size, args.size, camera_fov=0.8, device=args.device)
    image = camera.allocate_image_color_hdr(1, args.size, args.size)

    args.out.mkdir(parents=True, exist_ok=True)
    for frame in range(args.frames):
        camera.update(state, poses, rays, hdr_color_image=image)
        write_image(args.out / f"cloth_{frame:03d}.png", image.numpy()[0])
        for _ in range(25):
            state.clear_forces()
            collisions.collide(state, contacts)
            solver.step(state, after, control, contacts, 1.0 / 300.0)
            state, after = after, state
    assert np.isfinite(state.particle_q.numpy()).all()


if __name__ == "__main__":
    main()
