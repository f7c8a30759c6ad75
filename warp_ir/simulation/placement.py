"""From poses to what rays read of instances: their transforms, boxes and sort keys, by kernels."""

import warp as wp

from warp_ir.bvh import Bvh, Instance, on_cuda
from warp_ir.bvh.refit import is_used, refit_block, refit_inner_box, refit_leaf_box
from warp_ir.bvh.warp_bvh import box_corner, root_node, tree_of_mesh
from warp_ir.device_scene import SceneData
from warp_ir.simulation.top_tree import KEY_BITS
from warp_ir.vpl.sets import morton_code

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_INFINITY = wp.constant(3.0e38)
_MARGIN = wp.constant(16.0 * 2.0**-23)
_LAST_KEY = wp.constant((1 << (KEY_BITS - 1)) | ((1 << 30) - 1))
_LARGE = wp.constant(1 << 30)
_CODE_CELLS = wp.constant(1024)


@wp.struct
class Prototypes:
    """Geometry that is stored once, in a frame of its own: own = (local - origin) scale."""

    origin: wp.array[wp.vec3]
    scale: wp.array[wp.float32]
    lower: wp.array[wp.vec3]  # corners of its box, in its own frame
    upper: wp.array[wp.vec3]


@wp.struct
class Placements:
    """Instances: which prototype is where."""

    prototype: wp.array[wp.int32]
    group: wp.array[wp.int32]  # its world; the number of worlds: it is in all of them
    transforms: wp.array[wp.transformf]  # world from body
    stretch: wp.array[wp.mat33]  # body from prototype: scale and shear, a constant
    inverse_stretch: wp.array[wp.mat33]
    in_device: wp.array[wp.int32]  # 1: the points of its prototype are in the device frame already
    unbounded: wp.array[wp.int32]  # 1: much larger than what happens around it


@wp.struct
class WorldFrames:
    """Where worlds are looked at: the ball of details of each, and how far from it a body may be; last the shared."""

    origin: wp.vec3  # of the device frame: device = (world - origin) scale
    scale: float
    focus: wp.array[wp.vec3]  # [worlds + 1], device frame
    radius: wp.array[wp.float32]  # [worlds + 1]
    reach: wp.array[wp.float32]  # [worlds + 1], distance from the focus at which bodies drop out


@wp.struct
class PlacedBoxes:
    """What is computed of the instances."""

    lower: wp.array[wp.vec3]
    upper: wp.array[wp.vec3]
    keys: wp.array[wp.int32]
    instances: wp.array[Instance]
    axes: wp.array[wp.mat33]


@wp.func
def is_finite(t: wp.transformf) -> bool:
    """Whether a pose has neither NaN nor infinity, and a rotation."""
    p = wp.transform_get_translation(t)
    squared = wp.length_sq(wp.transform_get_rotation(t))
    return wp.isfinite(p[0] + p[1] + p[2]) and wp.isfinite(squared) and squared > 0.0


@wp.func
def rotation_of(t: wp.transformf) -> wp.mat33:
    """The rotation of a pose, whatever the length of its quaternion, which drifts in simulations."""
    return wp.quat_to_matrix(wp.normalize(wp.transform_get_rotation(t)))


@wp.func
def same_pose(a: wp.transformf, b: wp.transformf) -> bool:
    """Whether two poses are equal bit by bit, but for the sign of zeros; one with NaN equals none."""
    p = wp.transform_get_translation(a) - wp.transform_get_translation(b)
    q = wp.transform_get_rotation(a)
    r = wp.transform_get_rotation(b)
    return p == wp.vec3(0.0) and q[0] == r[0] and q[1] == r[1] and q[2] == r[2] and q[3] == r[3]


@wp.func
def move_instance(placements: Placements, changed: wp.array[wp.int32], i: int, pose: wp.transformf) -> None:
    """Moves an instance; marks its world as changed if it was elsewhere. Threads may mark one world: all write 1."""
    if not same_pose(placements.transforms[i], pose):
        placements.transforms[i] = pose
        changed[placements.group[i]] = 1


@wp.func
def color_instance(
    placements: Placements, colors: wp.array[wp.vec3], changed: wp.array[wp.int32], i: int, color: wp.vec3
) -> None:
    """Colours an instance; marks its world as changed if it had another colour."""
    if not (colors[i] == color):
        colors[i] = color
        changed[placements.group[i]] = 1


@wp.func
def _selected(rows: wp.array[wp.int32], k: int) -> int:
    """The k-th of the selected rows; no rows are all of them in order."""
    if rows.shape[0] > 0:
        return rows[k]
    return k


@wp.kernel
def _move_instances(
    first: int,
    rows: wp.array[wp.int32],
    poses: wp.array[wp.transformf],
    placements: Placements,
    changed: wp.array[wp.int32],
) -> None:
    """Moves a selected instance."""
    k = first + wp.tid()
    move_instance(placements, changed, _selected(rows, k), poses[k])


@wp.kernel
def _color_instances(
    first: int,
    rows: wp.array[wp.int32],
    source: wp.array[wp.vec3],
    placements: Placements,
    colors: wp.array[wp.vec3],
    changed: wp.array[wp.int32],
) -> None:
    """Colours a selected instance."""
    k = first + wp.tid()
    color_instance(placements, colors, changed, _selected(rows, k), source[k])


@wp.struct
class MovingPoints:
    """The points of all meshes that deform, mesh after mesh."""

    rows: wp.array[wp.int32]  # in the table of points
    prototype: wp.array[wp.int32]
    group: wp.array[wp.int32]


@wp.kernel
def _set_points(
    first: int,
    source: wp.array[wp.vec3],
    selection: wp.array[wp.int32],
    begin: int,
    moving: MovingPoints,
    prototypes: Prototypes,
    points: wp.array[wp.vec3],
    changed: wp.array[wp.int32],
) -> None:
    """Writes a point in its prototype's own frame, the origin if it is not finite; a selection lists the sources."""
    k = first + wp.tid()
    i = _selected(selection, k)
    row = moving.rows[begin + k]
    prototype = moving.prototype[begin + k]
    p = (source[i] - prototypes.origin[prototype]) * prototypes.scale[prototype]
    if not wp.isfinite(p[0] + p[1] + p[2]):
        p = wp.vec3(0.0)
    if not (points[row] == p):
        points[row] = p
        changed[moving.group[begin + k]] = 1


@wp.kernel
def _bake_points(
    first: int,
    instance: wp.array[wp.int32],
    rest: wp.array[wp.vec3],
    point_rows: wp.array[wp.int32],
    placements: Placements,
    worlds: WorldFrames,
    points: wp.array[wp.vec3],
) -> None:
    """Writes a point of an instance whose geometry is in the device frame: of one that emits, so that it is sampled.

    The surface shrinks to a point, which emits nothing, where its pose is not finite.
    """
    k = first + wp.tid()
    i = instance[k]
    pose = placements.transforms[i]
    p = wp.vec3(0.0)
    if is_finite(pose):
        local = rotation_of(pose) * (placements.stretch[i] * rest[k])
        p = (local + (wp.transform_get_translation(pose) - worlds.origin)) * worlds.scale
        if wp.length(p - worlds.focus[placements.group[i]]) > worlds.reach[placements.group[i]]:
            p = wp.vec3(0.0)
    points[point_rows[k]] = p


@wp.func
def _key(lower: wp.vec3, upper: wp.vec3, focus: wp.vec3, radius: float) -> int:
    """The place of a box on a Z-order curve around a ball; large boxes come after all small ones."""
    code = morton_code((0.5 * (lower + upper) - focus) / (4.0 * radius), _CODE_CELLS)
    if wp.length(upper - lower) > radius:
        code = code | _LARGE
    return code


@wp.kernel
def _place_instances(
    first: int, placements: Placements, prototypes: Prototypes, worlds: WorldFrames, out: PlacedBoxes
) -> None:
    """Computes what rays read of an instance; one that is not finite, or far away, gets an empty box."""
    i = first + wp.tid()
    group = placements.group[i]
    k = placements.prototype[i]
    pose = placements.transforms[i]
    lower = wp.vec3(_INFINITY)
    upper = wp.vec3(-_INFINITY)
    centre = wp.vec3(0.0)
    axes = wp.identity(n=3, dtype=wp.float32)
    inverse = wp.identity(n=3, dtype=wp.float32)
    magnitude = float(0.0)
    key = int(_LAST_KEY)
    if is_finite(pose):
        if placements.in_device[i] == 0:
            rotation = rotation_of(pose)
            stretch = rotation * placements.stretch[i]
            own_scale = prototypes.scale[k]
            axes = stretch * (worlds.scale / own_scale)
            inverse = placements.inverse_stretch[i] * wp.transpose(rotation) * (own_scale / worlds.scale)
            place = wp.transform_get_translation(pose) - worlds.origin  # first, so that far away little is rounded
            centre = (place + stretch * prototypes.origin[k]) * worlds.scale
        half = 0.5 * (prototypes.upper[k] - prototypes.lower[k])
        middle = 0.5 * (prototypes.upper[k] + prototypes.lower[k])
        reach = wp.vec3(0.0)
        back = wp.vec3(0.0)
        for row in range(3):
            for column in range(3):
                reach[row] += wp.abs(axes[row, column]) * half[column]
        farthest = reach + wp.abs(axes * middle)
        for row in range(3):
            for column in range(3):
                back[row] += wp.abs(inverse[row, column]) * farthest[column]
        for row in range(3):
            magnitude = wp.max(magnitude, wp.dot(wp.abs(axes[row]), back))
        if placements.unbounded[i] == 1:
            # Rounding is bounded by the coordinates of the triangle that is hit, which users of `magnitude` add.
            magnitude = 0.0
        magnitude += wp.max(wp.abs(centre))
        middle = axes * middle + centre
        if wp.length(middle - worlds.focus[group]) < worlds.reach[group]:
            margin = wp.vec3(magnitude * _MARGIN)
            lower = middle - reach - margin
            upper = middle + reach + margin
            key = _key(lower, upper, worlds.focus[group], worlds.radius[group])
    out.lower[i] = lower
    out.upper[i] = upper
    out.keys[i] = key
    out.axes[i] = axes
    out.instances[i].inverse = inverse
    out.instances[i].centre = centre
    out.instances[i].magnitude = magnitude


@wp.kernel
def _read_prototype_boxes(
    first: int, roots: wp.array[wp.int32], rows: wp.array[wp.int32], bvh: Bvh, prototypes: Prototypes
) -> None:
    """Takes the box of a prototype whose points have changed from the root of its tree (`Instance.root`)."""
    k = first + wp.tid()
    node = roots[k]
    lower = wp.vec3()
    upper = wp.vec3()
    if on_cuda():
        tree = tree_of_mesh(bvh.meshes[node].mesh)
        lower = box_corner(tree, root_node(tree), 0)
        upper = box_corner(tree, root_node(tree), 1)
    else:
        for axis in range(3):
            lower[axis] = wp.min(bvh.nodes[6 * node + axis])
            upper[axis] = wp.max(bvh.nodes[6 * node + 3 + axis])
    prototypes.lower[rows[k]] = lower
    prototypes.upper[rows[k]] = upper


@wp.kernel
def _refit_block_list(
    first: int, blocks: wp.array[wp.vec2i], points: wp.array[wp.vec3], indices: wp.array[wp.int32], bvh: Bvh
) -> None:
    """Reads the corners of a block's triangles again; a block, and what to add to its triangles to get their rows."""
    block = blocks[first + wp.tid()]
    refit_block(bvh, block[0], block[1], points, indices)


@wp.kernel
def _refit_node_list(first: int, nodes: wp.array[wp.int32], bvh: Bvh) -> None:
    """Recomputes the boxes of a node's children, which are leaves, or nodes that are done."""
    node = nodes[first + wp.tid()]
    for k in range(8):
        if is_used(bvh, node, k):
            if bvh.children[node][k] >= 0:
                refit_inner_box(bvh, node, k)
            else:
                refit_leaf_box(bvh, node, k)


@wp.struct
class WorldTargets:
    """Where photons of lights at infinity are aimed in each world: the annuli of `lights.PhotonTarget`."""

    annuli: int
    lights: int
    focus: wp.array2d[wp.vec4]  # [worlds, lights]
    cdf: wp.array2d[wp.float32]  # [worlds, lights (annuli + 1)]


@wp.kernel
def _update_worlds(
    first: int,
    worlds: wp.array[SceneData],
    roots: wp.array[wp.int32],
    frames: WorldFrames,
    targets: WorldTargets,
    changed: wp.array[wp.int32],
    versions: wp.array[wp.int32],
) -> None:
    """Computes the bounding sphere of a world with what all worlds share, and where its photons are aimed.

    The last index is that of the shared instances: it has a version alone. Half of the photons pass the ball of
    details, the others annuli around it, each twice as wide as the one before, until they cover the sphere.
    """
    w = first + wp.tid()
    versions[w] += changed[w]
    changed[w] = 0
    if w >= worlds.shape[0]:
        return
    tree = worlds[w].two_level[0].tree
    lower = wp.vec3(_INFINITY)
    upper = wp.vec3(-_INFINITY)
    for axis in range(3):
        lower[axis] = wp.min(tree.nodes[6 * roots[w] + axis])
        upper[axis] = wp.max(tree.nodes[6 * roots[w] + 3 + axis])
    focus = frames.focus[w]
    centre = focus
    radius = frames.radius[w]
    if lower[0] <= upper[0]:
        centre = 0.5 * (lower + upper)
        radius = wp.max(0.50005 * wp.length(upper - lower), 1.0e-6 * radius)
    worlds[w].centre = centre
    worlds[w].radius = radius
    worlds[w].focus = focus
    worlds[w].focus_radius = wp.min(frames.radius[w], radius)
    needed = radius + wp.length(focus - centre)
    count = int(1)
    while count < targets.annuli and needed / float(1 << (count - 1)) >= 2.0 * frames.radius[w]:
        count += 1
    outer = needed * float(1 << (targets.annuli - count))
    for light in range(targets.lights):
        targets.focus[w, light] = wp.vec4(focus[0], focus[1], focus[2], outer)
        total = float(0.0)
        for k in range(targets.annuli + 1):
            targets.cdf[w, light * (targets.annuli + 1) + k] = total
            if k < count:
                total += 0.5 / float(count) + wp.where(k == 0, 0.5, 0.0)
            if k >= count - 1:
                total = 1.0


@wp.kernel
def _update_emitter_areas(
    first: int,
    worlds: wp.array[SceneData],
    width: int,
    triangle_kind: int,
    static_pdf: wp.array[wp.float32],
    pdf_area: wp.array[wp.float32],
) -> None:
    """The area pdf of samples on an emissive triangle, whose area may have changed; others keep theirs."""
    i = first + wp.tid()
    w = i // width
    emitter = i - w * width
    pdf = static_pdf[i]
    if emitter < worlds[w].emitter_count:
        if worlds[w].emitter_kind[emitter] == triangle_kind:
            scene = worlds[w]
            triangle = scene.emitter_item[emitter]
            a = scene.points[scene.indices[3 * triangle]]
            b = scene.points[scene.indices[3 * triangle + 1]]
            c = scene.points[scene.indices[3 * triangle + 2]]
            area = 0.5 * wp.length(wp.cross(b - a, c - a)) * float(1 + scene.emits_back[triangle])
            pdf = wp.min((scene.emitter_cdf[emitter + 1] - scene.emitter_cdf[emitter]) / area, 1.0e30)
    pdf_area[i] = pdf


@wp.kernel
def _find_group_roots(first: int, tree: wp.uint64, roots: wp.array[wp.int32]) -> None:
    """Writes the root of a group in Warp's tree of boxes; negative if it has no member."""
    group = first + wp.tid()
    roots[group] = wp.bvh_get_group_root(tree, group)
