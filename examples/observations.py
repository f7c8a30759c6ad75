"""Images as observations of a policy in PyTorch: tensors that are the sensor's own arrays.

    python examples/observations.py --steps 20

A ball in each of several worlds is pushed by a small network that sees the world through a camera. It learns nothing
here; what matters is that between simulation, camera and network nothing is copied to the host.
"""

import argparse

import newton
import torch
import warp as wp

from warp_ir.newton import GiSettings, SensorCamera


def build(worlds: int, device: str) -> newton.Model:
    one = newton.ModelBuilder()
    body = one.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.3), wp.quat_identity()))
    one.add_shape_sphere(body, radius=0.3, color=(0.9, 0.4, 0.1))
    model = newton.ModelBuilder()
    model.replicate(one, worlds)
    model.add_ground_plane()
    return model.finalize(device=device)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--size", type=int, default=16)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    model = build(args.worlds, args.device)
    state, after = model.state(), model.state()
    solver, control = newton.solvers.SolverXPBD(model), model.control()
    collisions = newton.CollisionPipeline(model)
    contacts = collisions.contacts()
    camera = SensorCamera(model, gi=GiSettings(light_paths=128))
    camera.create_default_light()
    down = wp.transform(wp.vec3(0.0, -2.5, 1.8), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 1.0))
    poses = wp.array([down] * args.worlds, dtype=wp.transformf, device=args.device)
    rays = SensorCamera.compute_camera_rays_pinhole(args.size, args.size, camera_fov=0.9, device=args.device)
    image = camera.allocate_image_color_hdr(args.worlds, args.size, args.size)
    observation = wp.to_torch(image)  # the same memory, [worlds, rows, columns, 3]
    policy = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(3 * args.size**2, 2)).to(observation.device)
    for _ in range(args.steps):
        camera.update(state, poses, rays, hdr_color_image=image)
        with torch.no_grad():
            push = policy(observation)
        state.clear_forces()
        wp.to_torch(state.body_f)[:, :2] += 20.0 * push
        collisions.collide(state, contacts)
        solver.step(state, after, control, contacts, 1.0 / 60.0)
        state, after = after, state
    print("mean observation", float(observation.mean()))


if __name__ == "__main__":
    main()
