"""A scene that a simulation moves: its meshes are uploaded once, then poses, points and colours come from the device.

    live = LiveScene(scene)                      prototypes and instances, uploaded
    repeat
        live.set_transforms(poses)               arrays on the device, written by the simulation
        live.set_points("cloth", points)
        live.refit()                             boxes, trees, areas of lights, bounds: launches alone
        views.render(...)

Nothing of a step is done on the host: no array is read back, none is allocated, and the number of launches depends on
the scene and not on what moves. So a step can be recorded as a CUDA graph.

Instances belong to worlds. Worlds may overlap in space: every ray belongs to a world, and sees what is in it and what
all worlds share.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_ir.bvh import NO_TREE, Instance, InstanceTree, TwoLevel, empty_rows
from warp_ir.device.launch_list import LaunchList
from warp_ir.device.launcher import Launcher, copy_record
from warp_ir.device.records import record_rows
from warp_ir.device_scene import (
    TRIANGLE_EMITTER,
    DeviceFrame,
    DeviceGeometry,
    MeshBatch,
    SceneData,
    check_scene,
    snapped_frame_of_box,
    upload_lights,
)
from warp_ir.sampling import sobol
from warp_ir.scene import Bools, Floats, InputError, Instances, Ints, Light, Material, Mesh, Scene
from warp_ir.simulation import placement
from warp_ir.simulation.bodies import areas, backgrounds, bodies_of, quaternions, rotations_and_stretches, world_balls
from warp_ir.simulation.placement import MovingPoints, PlacedBoxes, Placements, Prototypes, WorldFrames, WorldTargets
from warp_ir.simulation.top_tree import new_top_tree, refit_top_tree
from warp_ir.simulation.world_emitters import new_world_emitters

_ANNULI = 24
"""Annuli around the ball of details at which photons are aimed: enough for a ground 10⁶ times as large."""
_REACH = 1000.0
"""Distance from the centre of the ball of details, in its radii, at which a body drops out of its world."""
_MOST_REPEATED = 64
"""Launches whose packed arguments are kept."""
_TEXTURE_PATCHES = 2**14
"""As in `device_scene.upload`."""


class LiveScene:
    """A scene on a device whose instances, points and colours change from step to step."""

    def __init__(
        self,
        scene: Scene,
        *,
        worlds: Ints | None = None,
        world_count: int = 1,
        ids: Ints | None = None,
        deforming: Collection[str] = (),
        unbounded: Collection[int] = (),
        extent: float | None = None,
        frame: DeviceFrame | None = None,
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        """Uploads a scene.

        Its meshes in world space become instances, in their order, and those of its `Instances` follow. The camera and
        what the scene says of motion blur are not used.

        Args:
            scene: Meshes, materials and lights; lights are in all worlds.
            worlds: World of each instance, int [n], from 0; -1: all worlds. None: all instances are in world 0.
            world_count: Number of worlds.
            ids: What an image of shape indices shows of each instance, uint32 [n]; None: its row.
            deforming: Names of meshes whose points will change: their normals are those of their triangles.
            unbounded: Rows of instances without an end, as infinite planes are. Frame, area and the aim of photons do
                not depend on them, nor on those that are eight times as large as the others of their world together.
            extent: Radius around what a world's instances show at first that matters most: half of the photons of
                distant lights and skies is aimed there [scene units]; None: that of the world's instances.
            frame: The frame of the device; None: that of all bounded instances.
            device: "cpu", "cuda" or "cuda:N".
            threads: CPU threads; by default one per core. Pictures do not depend on it.

        Raises:
            InputError: The scene cannot be used.
        """
        self.launcher = Launcher(device, threads)
        check_scene(scene, self.launcher, ())
        if extent is not None and not 0.0 < extent < np.inf:
            raise InputError(f"extent: must be a positive number, is {extent}")
        self._meshes = scene.meshes
        self._bodies = bodies = bodies_of(scene, deforming)
        count = bodies.count
        group = np.zeros(count, np.int64) if worlds is None else np.asarray(worlds, np.int64)
        if group.shape != (count,) or (count and not -1 <= group.min() <= group.max() < world_count):
            raise InputError(f"worlds: must be {count} numbers from -1 to {world_count - 1}")
        self.world_count = world_count
        """Number of worlds."""
        self.names = bodies.names
        """Name of each instance [n]: that of its mesh, or of its `Instances`."""
        self._group = np.where(group < 0, world_count, group)
        self._unbounded: Bools = np.zeros(count, bool)
        self._unbounded[list(unbounded)] = True
        self._background = self._unbounded | backgrounds(bodies, self._group, world_count + 1)
        balls = world_balls(bodies, self._group, world_count, ~self._background)
        self.frame = frame or _frame_of(balls)
        """The frame of the device."""
        self._radii = (balls[:, 3] if extent is None else np.full(world_count + 1, extent)) * self.frame.scale
        self._upload_geometry(balls)
        array = self.launcher.array
        self.ids = array(np.arange(count) if ids is None else np.asarray(ids), wp.uint32)
        """What an image of shape indices shows of each instance."""
        self.changed = array(np.zeros(world_count + 1), wp.int32)
        """1: the world has changed since the last `refit`; last, what all worlds share."""
        self.versions = array(np.zeros(world_count + 1), wp.int32)
        """How often each world has changed."""
        self._textured = True
        self.lights_version = 0
        """How often the lights have been replaced."""
        self._refitting: LaunchList | None = None
        self._repeated: dict[tuple[Any, ...], LaunchList] = {}
        self.set_lights(scene.lights)
        self.refit()

    @classmethod
    def from_meshes(
        cls,
        meshes: "Sequence[wp.Mesh]",
        prototypes: Ints | None = None,
        *,
        colors: Floats | None = None,
        lights: Sequence[Light] = (),
        worlds: Ints | None = None,
        world_count: int = 1,
        deforming: bool = False,
        device: str = "cpu",
        threads: int | None = None,
    ) -> "LiveScene":
        """A scene of Warp's meshes, whose points and triangles are copied.

        Args:
            meshes: The prototypes. Their names are "0", "1", ...
            prototypes: The mesh of each instance, ascending [n]; None: each is drawn once. Poses are identities.
            colors: Albedo of each instance, linear [n, 3]; None: 0.18.
            lights: Lights of all worlds.
            worlds: As for the class.
            world_count: As for the class.
            deforming: Whether all points will change, each mesh being drawn once.
            device: As for the class.
            threads: As for the class.
        """
        which = np.arange(len(meshes)) if prototypes is None else np.asarray(prototypes)
        if (np.diff(which) < 0).any() or (len(which) and not 0 <= which[0] <= which[-1] < len(meshes)):
            raise InputError(f"prototypes: must be ascending numbers from 0 to {len(meshes) - 1}")
        albedo = np.full((len(which), 3), 0.18) if colors is None else np.asarray(colors)
        all_meshes: list[Mesh] = []
        groups: list[Instances] = []
        for k, mesh in enumerate(meshes):
            rows = np.flatnonzero(which == k)
            if len(rows):
                triangles = mesh.indices.numpy().reshape(-1, 3)
                groups.append(
                    Instances(str(k), (len(all_meshes),), np.tile(np.eye(4), (len(rows), 1, 1)), albedo[rows])
                )
                all_meshes.append(
                    Mesh(
                        str(k),
                        mesh.points.numpy().astype(np.float64),
                        triangles,
                        np.zeros(len(triangles), np.int32),
                        bare=np.ones(len(triangles), bool),
                    )
                )
        scene = Scene(tuple(all_meshes), (Material(),), tuple(lights), instances=tuple(groups))
        return cls(
            scene,
            worlds=worlds,
            world_count=world_count,
            deforming=[group.name for group in groups] if deforming else (),
            device=device,
            threads=threads,
        )

    @property
    def count(self) -> int:
        """Number of instances."""
        return self._bodies.count

    @property
    def transforms(self) -> "wp.array[wp.transformf]":
        """The pose of each instance [n], on the device: to be read; `set_transforms` writes them."""
        return self.placements.transforms

    @property
    def deforming_rows(self) -> "wp.array[wp.int32]":
        """The rows in the table of points of all meshes that deform."""
        return self._moving_points.rows if self.deforming else self._all_rows

    @property
    def has_normals(self) -> bool:
        """Whether any surface has normals of its own."""
        return self._bodies.scene.has_normals

    @property
    def glows(self) -> bool:
        """Whether any surface emits, or seems to."""
        return self._bodies.scene.glows

    def rows(self, name: str) -> list[int]:
        """The rows of the instances of a name."""
        return [row for row, own in enumerate(self.names) if own == name]

    def set_transforms(self, transforms: "wp.array[wp.transformf]", rows: "wp.array[wp.int32] | None" = None) -> None:
        """Moves instances: world from body, where scale and shear that an instance began with stay.

        Args:
            transforms: Poses, transformf [n], or as many as there are rows.
            rows: Which instances, each once; None: all of them.
        """
        count = self._check_rows(transforms, rows)
        self.repeat(
            placement._move_instances,
            count,
            [self._all_rows if rows is None else rows, transforms, self.placements, self.changed],
        )

    def set_colors(self, colors: "wp.array[wp.vec3]", rows: "wp.array[wp.int32] | None" = None) -> None:
        """Sets the albedo of instances where their scene gave them colours (`Instances.colors`); linear, in [0, 1].

        Args:
            colors: vec3 [n], or as many as there are rows.
            rows: Which instances, each once; None: all of them.
        """
        count = self._check_rows(colors, rows)
        self.repeat(
            placement._color_instances,
            count,
            [
                self._all_rows if rows is None else rows,
                colors,
                self.placements,
                self.data.instance_colors,
                self.changed,
            ],
        )

    def set_points(
        self, names: str | Sequence[str], points: "wp.array[wp.vec3]", selection: "wp.array[wp.int32] | None" = None
    ) -> None:
        """Sets the points of a mesh that deforms, or of several at once, in the space of their prototypes.

        Args:
            names: Name of the mesh, or of meshes that follow each other in `deforming`.
            points: vec3, one for each of their points, mesh after mesh, or any array that `selection` takes them from.
            selection: int32, index into `points` of each of their points; None: they are in order.

        Raises:
            InputError: There is no such mesh, or the number of points is another.
        """
        each = (names,) if isinstance(names, str) else names
        if not each or any(name not in self.deforming for name in each):
            raise InputError(f"{names}: is no mesh that deforms")
        begin, end = self.deforming[each[0]].start, self.deforming[each[-1]].stop
        if (points if selection is None else selection).shape[0] != end - begin:
            raise InputError(f"{each[0]}: {end - begin} points are wanted")
        selected = self._all_rows if selection is None else selection
        inputs = [points, selected, begin, self._moving_points, self._prototypes, self.data.points, self.changed]
        self.repeat(placement._set_points, end - begin, inputs)

    def set_lights(self, lights: Sequence[Light]) -> None:
        """Replaces the lights of all worlds. This is not part of a step: it works on the host."""
        bodies, launcher, frame = self._bodies, self.launcher, self.frame
        self._lights = tuple(lights)
        scene = Scene(self._meshes, bodies.scene.materials, self._lights)  # links name its meshes
        reference = float(self._radii[0])
        self.data.centre, self.data.radius = wp.vec3(0.0), reference
        self.data.focus, self.data.focus_radius = self.data.centre, reference
        uploaded = upload_lights(scene, frame, self.data, launcher)
        firsts = self._geometry.first_triangles(0)
        lit = replace(bodies, scene=replace(bodies.scene, lights=self._lights))
        self._emitters = new_world_emitters(
            lit,
            self._group,
            firsts,
            uploaded.power,
            uploaded.area,
            self._radii[:-1],
            reference,
            frame.scale,
            self.data.triangle_count,
            launcher,
        )
        self._light_owners = uploaded.owners
        count = max(self.data.light_count, 1)
        self.targets = WorldTargets()
        """Where photons of lights at infinity are aimed in each world."""
        self.targets.annuli, self.targets.lights = _ANNULI, count
        self.targets.focus = launcher.zeros((self.world_count, count), wp.vec4)
        self.targets.cdf = launcher.zeros((self.world_count, count * (_ANNULI + 1)), wp.float32)
        self._write_worlds()
        self._refitting = None
        self.lights_version += 1

    @property
    def lights(self) -> tuple[Light, ...]:
        """The lights of all worlds."""
        return self._lights

    def show_textures(self, shown: bool) -> None:
        """Whether surfaces have their textures, or what these would multiply. This works on the host."""
        if shown != self._textured:
            self._textured = shown
            self._write_worlds()
            self.refit()

    def refit(self) -> None:
        """Brings everything up to date that depends on poses and points: by launches alone."""
        if self._refitting is None:
            self._refitting = self._refit_launches()
        with self.launcher.phase("refit"):
            self._refitting.run()

    def _refit_launches(self) -> LaunchList:
        out, data, boxes = LaunchList(self.launcher), self.data, self._boxes
        if self._baked is not None:
            inputs = [*self._baked, self.placements, self.frames, data.points]
            out.launch(placement._bake_points, self._baked[0].shape[0], inputs)
        self._add_moving_trees(out)
        out.launch(placement._place_instances, self.count, [self.placements, self._prototypes, self.frames, boxes])
        refit_top_tree(self._top, self.placements.group, boxes.keys, self._sort_keys, boxes.lower, boxes.upper, out)
        if self._box_tree is not None:
            out.call(self._box_tree.refit)
        self._add_world_updates(out)
        return out

    def _add_world_updates(self, out: LaunchList) -> None:
        emitters = self._emitters
        inputs = [self.worlds, self._roots, self.frames, self.targets, self.changed, self.versions]
        out.launch(placement._update_worlds, self.world_count + 1, inputs)
        if emitters.has_triangles:
            pdf = emitters.pdf_area.flatten()
            inputs = [self.worlds, emitters.width, TRIANGLE_EMITTER, emitters.static_pdf, pdf]
            out.launch(placement._update_emitter_areas, pdf.shape[0], inputs)

    def _add_moving_trees(self, out: LaunchList) -> None:
        data = self.data
        if not self._moving:
            return
        if self.launcher.device.is_cuda:
            for batch in self._moving:
                out.call(partial(self._geometry.refit_boxes, batch))
        else:
            inputs = [self._blocks, data.points, data.indices, data.bvh]
            out.launch(placement._refit_block_list, self._blocks.shape[0], inputs)
            for nodes in self._node_levels:
                out.launch(placement._refit_node_list, nodes.shape[0], [nodes, data.bvh])
        inputs = [self._moving_roots, self._moving_rows, data.bvh, self._prototypes]
        out.launch(placement._read_prototype_boxes, len(self._moving), inputs)

    def repeat(self, kernel: Any, count: int, inputs: Sequence[Any]) -> None:
        """A launch that is likely to be repeated with the same arrays; all records among its inputs are the scene's."""
        values = (x.ptr if isinstance(x, wp.array) else x if isinstance(x, int) else id(x) for x in inputs)
        key = (kernel, count, *values)
        if key not in self._repeated:
            if len(self._repeated) >= _MOST_REPEATED:
                self._repeated.clear()
            self._repeated[key] = LaunchList(self.launcher)
            self._repeated[key].launch(kernel, count, inputs)
        self._repeated[key].run()

    def _check_rows(self, values: Any, rows: "wp.array[wp.int32] | None") -> int:
        count = self.count if rows is None else int(rows.shape[0])
        if values.shape[0] != count:
            raise InputError(f"{values.shape[0]} values for {count} instances")
        return count

    def _upload_geometry(self, balls: Floats) -> None:
        """Uploads the prototypes, and makes the tables of instances and the trees over them."""
        bodies, launcher, array = self._bodies, self.launcher, self.launcher.array
        self._geometry = DeviceGeometry(launcher)
        self._geometry.update([(bodies.scene, bodies.mesh_indices)], self.frame)
        self.data = data = SceneData()
        self._geometry_owners = self._geometry.fill(0, data)
        batches = self._geometry.prototypes(0)
        roots = self._geometry.prototype_roots(0)
        half = np.array([b.half_extent for b in batches]).reshape(-1, 3)
        self._prototypes = prototypes = Prototypes()
        prototypes.origin = array(np.array([b.frame.origin for b in batches]).reshape(-1, 3), wp.vec3)
        prototypes.scale = array(np.array([b.frame.scale for b in batches]), wp.float32)
        prototypes.lower, prototypes.upper = array(-half, wp.vec3), array(half, wp.vec3)

        count = bodies.count
        finite: Bools = np.asarray(np.isfinite(bodies.matrices).all(axis=(1, 2)))
        matrices = np.where(finite[:, None, None], bodies.matrices, np.eye(4))
        rotation, stretch = rotations_and_stretches(matrices[:, :3, :3])
        if count and not (np.abs(np.linalg.det(stretch)) > 0.0).all():
            raise InputError("instances: a matrix is singular")
        poses = np.concatenate([matrices[:, :3, 3], quaternions(rotation)], axis=1)
        poses[~finite] = np.nan
        self.placements = placements = Placements()
        placements.prototype, placements.group = array(bodies.prototype, wp.int32), array(self._group, wp.int32)
        placements.transforms = array(poses.astype(np.float32), wp.transformf)
        placements.stretch = array(stretch.astype(np.float32), wp.mat33)
        placements.inverse_stretch = array(np.linalg.inv(stretch).astype(np.float32), wp.mat33)
        placements.in_device = array(np.array(bodies.emits, np.int32)[bodies.prototype], wp.int32)
        placements.unbounded = array(self._unbounded.astype(np.int32), wp.int32)
        self._all_rows = launcher.empty(0, wp.int32)

        instances = empty_rows(Instance, count)
        instances["root"] = np.array(roots, np.int32)[bodies.prototype]
        instances["triangle_offset"] = np.array([b.triangle_rows.start for b in batches], np.int32)[bodies.prototype]
        self._boxes = boxes = PlacedBoxes()
        boxes.instances = array(instances, Instance) if count else launcher.zeros(1, Instance)
        boxes.axes = launcher.zeros(max(count, 1), wp.mat33)
        boxes.keys = launcher.zeros(max(count, 1), wp.int32)
        boxes.lower, boxes.upper = launcher.zeros(max(count, 1), wp.vec3), launcher.zeros(max(count, 1), wp.vec3)
        self._sort_keys = launcher.zeros(max(2 * count, 1), wp.int64)
        data.instance_count, data.instances, data.instance_axes = count, boxes.instances, boxes.axes
        data.instance_colors = array(bodies.colors if count else np.zeros((1, 3)), wp.vec3)
        data.tinted = 1
        self._textures = data.texture_count

        centres = self.frame.to_device(balls[:, :3])
        self.frames = frames = WorldFrames()
        frames.origin, frames.scale = wp.vec3(*self.frame.origin.tolist()), self.frame.scale
        frames.focus, frames.radius = array(centres, wp.vec3), array(self._radii, wp.float32)
        reach = np.append(_REACH * self._radii[:-1], 3.0e38)
        frames.reach = array(reach, wp.float32)
        area = areas(bodies) * self.frame.scale**2
        bounded = np.bincount(self._group, np.where(self._background, 0.0, area), self.world_count + 1)
        grounds = np.bincount(self._group, self._background, self.world_count + 1)
        totals = bounded[:-1] + bounded[-1] + np.pi * self._radii[:-1] ** 2 * np.minimum(grounds[:-1] + grounds[-1], 1)
        self.areas = array(np.maximum(totals, 1.0e-30), wp.float32)
        """Area of the surfaces of each world; of unbounded ones only what is near."""
        data.footprint = float(np.sqrt(totals[0] / _TEXTURE_PATCHES))
        self._footprints = np.sqrt(totals / _TEXTURE_PATCHES)
        self._list_moving_trees(batches, roots)

        self._top = new_top_tree(self._group, self.world_count, launcher)
        self._roots = array(self._top.roots, wp.int32)
        self._box_tree = None
        if launcher.device.is_cuda and count:
            self._box_tree = wp.Bvh(boxes.lower, boxes.upper, groups=placements.group, constructor="sah")

    def _list_moving_trees(self, batches: Sequence[MeshBatch], roots: Sequence[int]) -> None:
        """Lists the trees whose points change: those that deform, and those that emit and are baked."""
        bodies, launcher, data = self._bodies, self.launcher, self.data
        row = np.zeros(len(batches), np.int64)
        row[bodies.prototype] = np.arange(bodies.count)
        moving = [k for k in range(len(batches)) if bodies.emits[k] or bodies.deforms[k]]
        self._moving = [batches[k] for k in moving]
        self._moving_roots = launcher.array(np.array([roots[k] for k in moving], np.int32), wp.int32)
        self._moving_rows = launcher.array(np.array(moving, np.int32), wp.int32)
        self.deforming: dict[str, range] = {}
        """Of each mesh that deforms, the range of its points among those of all."""
        deforming = [k for k in moving if bodies.deforms[k]]
        counts = [len(batches[k].point_rows) for k in deforming]
        for k, begin, count in zip(deforming, np.cumsum([0, *counts]).tolist(), counts, strict=False):
            self.deforming[bodies.names[row[k]]] = range(begin, begin + count)
        self._moving_points = table = MovingPoints()
        rows = [np.asarray(batches[k].point_rows) for k in deforming] or [np.zeros(1, np.int64)]
        table.rows = launcher.array(np.concatenate(rows).astype(np.int32), wp.int32)
        table.prototype = launcher.array(np.repeat(deforming or [0], counts or [1]), wp.int32)
        table.group = launcher.array(
            np.repeat(self._group[row[deforming]] if deforming else [0], counts or [1]), wp.int32
        )
        self._baked = None
        baked = [k for k in moving if bodies.emits[k]]
        if baked:
            points = [m.points for k in baked for m in bodies.meshes(k)]
            instance = np.repeat(row[baked], [len(batches[k].point_rows) for k in baked])
            point_rows = np.concatenate([np.asarray(batches[k].point_rows) for k in baked])
            used = np.concatenate(points)
            used = np.where(np.isfinite(used).all(axis=1, keepdims=True), used, 0.0)
            array = launcher.array
            self._baked = (
                array(instance, wp.int32),
                array(used.astype(np.float32), wp.vec3),
                array(point_rows, wp.int32),
            )
        if not moving or launcher.device.is_cuda:
            return
        children = data.bvh.children.numpy()
        blocks: list[Ints] = []
        levels: dict[int, list[int]] = {}
        boxes = data.bvh.nodes.numpy().reshape(len(children), 6, -1)
        height = np.zeros(len(children), np.int64)
        used_lane = boxes[:, 0] <= boxes[:, 3]
        for batch in self._moving:
            nodes, own_blocks = self._geometry.tree_ranges(batch)
            offset = np.full(len(own_blocks), batch.triangle_rows.start)
            blocks.append(np.stack([np.asarray(own_blocks), offset], axis=1))
            for node in reversed(nodes):  # a node is stored before its children
                below = children[node][used_lane[node] & (children[node] >= 0)]
                height[node] = 1 + height[below].max() if len(below) else 0
                levels.setdefault(int(height[node]), []).append(node)
        self._blocks = launcher.array(np.concatenate(blocks).astype(np.int32), wp.vec2i)
        self._node_levels = [launcher.array(np.array(levels[h], np.int32), wp.int32) for h in sorted(levels)]

    def _write_worlds(self) -> None:
        """Writes the record of each world, at the same address as before; `_update_worlds` completes it."""
        launcher, data, count = self.launcher, self.data, self.world_count
        if not hasattr(self, "worlds"):
            self.worlds = launcher.empty(count, SceneData)
            """The record of each world for kernels."""
            self._two_level = self._new_two_level()
            data.sobol = launcher.array(sobol.sobol_matrices(), wp.uint32)
        data.texture_count = self._textures if self._textured else 0
        size = self.worlds.strides[0]

        def make(world: int) -> SceneData:
            record: SceneData = copy_record(data)
            record.two_level = self._two_level[world : world + 1]
            record.address = wp.uint64(self.worlds.ptr + world * size)
            self._emitters.slice(world, record)
            return record

        rows = record_rows(make, count, SceneData, launcher)
        rows["emitter_count"] = self._emitters.count
        rows["footprint"] = self._footprints
        self.worlds.assign(launcher.array(rows, SceneData))
        self.changed.fill_(1)

    def _new_two_level(self) -> Any:
        """Both levels of each world: the same tables, and a root of its own."""
        launcher, count = self.launcher, self.world_count
        tree = InstanceTree()
        for name in ("nodes", "children", "leaf_instances", "continues"):
            setattr(tree, name, getattr(self._top.tree, name))
        tree.instances = self._boxes.instances
        tree.bvh, tree.shared_root = wp.uint64(0), NO_TREE
        row = TwoLevel()
        row.bvh, row.tree = self.data.bvh, tree
        rows = record_rows(lambda _: row, count, TwoLevel, launcher)
        rows["tree"]["root"] = self._top.roots
        if self._box_tree is not None:
            roots = launcher.empty(count + 1, wp.int32)
            launcher.launch(placement._find_group_roots, count + 1, [self._box_tree.id, roots])
            found = roots.numpy()
            found[found < 0] = NO_TREE
            rows["tree"]["bvh"] = self._box_tree.id
            rows["tree"]["root"], rows["tree"]["shared_root"] = found[:-1], found[-1]
        return launcher.array(rows, TwoLevel)


_FRAME_GRID = 1024.0
"""Distance of the origins that `fixed_frame` chooses from."""


def fixed_frame(scene: Scene, unbounded: Collection[int] = ()) -> DeviceFrame:
    """A frame in scene units near the instances of a scene, which stays the same wherever they move nearby.

    Args:
        scene: The scene, all of whose meshes are instanced.
        unbounded: Rows of instances that do not count.
    """
    places = [np.zeros((0, 3))]
    for group in scene.instances:
        points = scene.meshes[group.meshes[0]].points
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0)) if len(points) else np.zeros(3)
        places.append(group.matrices[:, :3, :3] @ centre + group.matrices[:, :3, 3])
    every = np.concatenate(places)
    kept: Bools = np.asarray(np.isfinite(every).all(axis=1))
    kept[list(unbounded)] = False
    middle = np.median(every[kept], axis=0) if kept.any() else np.zeros(3)
    return DeviceFrame(np.round(middle / _FRAME_GRID) * _FRAME_GRID, 1.0)


def _frame_of(balls: Floats) -> DeviceFrame:
    """The frame in which balls [n, 4] fill a unit box."""
    return snapped_frame_of_box((balls[:, :3] - balls[:, 3:]).min(axis=0), (balls[:, :3] + balls[:, 3:]).max(axis=0))
