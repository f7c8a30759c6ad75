"""Pictures that go on from step to step: exactly while nothing changes, or carried along with what moves.

`static` keeps the sums of a view while nothing that it depends on differs from the last step by a bit: the mean stays
unbiased. `temporal` takes what a pixel's surface received in the last step from the pixel that showed it then
(reverse reprojection, Nehab et al. 2007):

    the point of the pixel's nearest hit        moved by the last pose of its instance, the last points of its mesh
    the pixel of the last picture that saw it   found by Newton's method in the bundle of rays
    the four pixels around it                   those of the same surface: instance, normal and tangent plane agree
    their mean irradiance                       goes on as if of `max_history` steps at most, and of fewer where it
                                                differs from that of this step by more than noise explains

Irradiance follows the surface, but light changes as bodies move. What is reused is late, which is a bias: as long as it
is smaller than the noise of a step nothing tells them apart.
"""

import warp as wp

from warp_ir.device_scene import SceneData
from warp_ir.reconstruction.filter import mean_channels
from warp_ir.simulation.placement import rotation_of, same_pose
from warp_ir.simulation.transport import ViewRays, ViewSums

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

UNLIT = wp.constant(-1)
"""Value of `ViewHistory.accumulates`: nothing of this call is kept, because it computes no light."""
OFF = wp.constant(0)
STATIC = wp.constant(1)
TEMPORAL = wp.constant(2)
_NONE = wp.constant(0)
"""Relation of a view to its last picture: it has none that can be used."""
_UNCHANGED = wp.constant(1)
_MOVED = wp.constant(2)
_MOST_STEPS = wp.constant(8)
"""Steps of Newton's method: a fisheye takes three, a pinhole two."""
_MIN_COSINE = wp.constant(0.9)
"""Of the normals of a surface in two steps."""
_PLANE_DISTANCE = wp.constant(2.0)
"""Widths of a pixel off the tangent plane at which a point lies on another surface."""
_RADIUS = wp.constant(1)
"""Pixels around one that tell whether its light has changed."""
_NOISE = wp.constant(1.0)
"""By how many variances of a step's mean the past may differ from it, squared, before it counts less."""
_OUTLIER = wp.constant(4.0)
"""By how many variances a step may differ from the last one, for half the square of it to count as noise."""
_RATE = wp.constant(0.25)
"""Share of the last difference in the variance."""
_MIN_WEIGHT = wp.constant(0.05)
"""Least share of the four pixels around a point that has to show its surface."""


@wp.struct
class ViewHistory:
    """What views showed in the last step."""

    accumulates: int  # OFF, STATIC or TEMPORAL; UNLIT: it stays as it is
    transforms: wp.array[wp.transformf]  # [views]
    last_transforms: wp.array[wp.transformf]  # those of the step before, while a step is rendered
    world: wp.array[wp.int32]
    version: wp.array[wp.int32]  # of the world and of what all worlds share, in sum
    has_pictures: wp.array[wp.int32]  # [views], 1: `LastPictures` has those of the last step
    relation: wp.array[wp.int32]  # [views]
    rays: wp.array4d[wp.vec3]  # empty unless it accumulates
    rays_changed: wp.array[wp.int32]  # [rows]


@wp.struct
class LastPictures:
    """What pixels showed at the end of the last step, one row for each pixel of each view."""

    count: wp.array[wp.vec2]  # iterations that the means stand for, direct and indirect; 0: no surface
    instance: wp.array[wp.int32]
    position: wp.array[wp.vec3]  # device frame
    normal: wp.array[wp.vec3]
    direct: wp.array[wp.vec3]  # means as in `ViewSums`
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.vec2]
    local: wp.array[
        wp.vec4
    ]  # means over the pixels around, direct and indirect, of this step alone; their variances, -1: not known
    radiance: wp.array[wp.vec3]
    square: wp.array[wp.float32]  # empty: no error is wanted


@wp.struct
class PastLight:
    """What `LastPictures` has of the surfaces that pixels show now."""

    count: wp.array[wp.vec2]
    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    squares: wp.array[wp.vec2]
    local: wp.array[wp.vec4]
    radiance: wp.array[wp.vec3]
    square: wp.array[wp.float32]


@wp.struct
class Motion:
    """Where instances and points are, and were in the last step."""

    transforms: wp.array[wp.transformf]
    last_transforms: wp.array[wp.transformf]
    moving: wp.array[wp.int32]  # row of a point in `last_points`, -1: its mesh does not deform; empty: none does
    last_points: wp.array[wp.vec3]


@wp.kernel
def _compare_rays(first: int, views: ViewRays, history: ViewHistory) -> None:
    """Whether a row of rays differs from that of the last step, whose place it takes."""
    row = first + wp.tid()
    changed = int(0)
    for column in range(views.columns):
        for sample in range(views.samples):
            for k in range(2):
                ray = views.rays[row, column, sample, k]
                if not (history.rays[row, column, sample, k] == ray):
                    history.rays[row, column, sample, k] = ray
                    changed = 1
    history.rays_changed[row] = changed


@wp.kernel
def _begin_views(
    first: int,
    ends: wp.array[wp.int32],
    versions: wp.array[wp.int32],
    views: ViewRays,
    history: ViewHistory,
    count: wp.array[wp.int32],
) -> None:
    """Gives a view the slot of its world, and begins its sums anew unless nothing has changed since the last step."""
    view = first + wp.tid()
    world = views.world[view]
    version = int(-1)
    if world >= 0:
        views.slot[view] = ends[world] - 1
        version = versions[world] + versions[versions.shape[0] - 1]
    else:
        views.slot[view] = -1
    if history.accumulates == UNLIT:
        return
    comparable = history.accumulates > OFF and history.world[view] == world
    if history.accumulates > OFF:
        for row in range(views.rows):
            if history.rays_changed[row] == 1:
                comparable = False
    pose = views.transforms[view]
    last = history.transforms[view]
    same = comparable and history.version[view] == version and same_pose(last, pose)
    if history.accumulates != STATIC or not same:
        count[view] = 0
    relation = int(_NONE)
    if comparable and history.has_pictures[view] == 1:
        relation = wp.where(same, _UNCHANGED, _MOVED)
    history.relation[view] = relation
    history.has_pictures[view] = wp.where(history.accumulates == TEMPORAL and world >= 0, 1, 0)
    history.last_transforms[view] = last
    history.transforms[view] = pose
    history.version[view] = version
    history.world[view] = world


@wp.kernel
def _end_views(first: int, iterations: int, count: wp.array[wp.int32], step: wp.array[wp.int32]) -> None:
    """Counts the iterations of a view; the first one counts the step."""
    view = first + wp.tid()
    count[view] += iterations
    if view == 0:
        step[0] += 1


@wp.func
def last_position(scene: SceneData, views: ViewRays, motion: Motion, sums: ViewSums, pixel: int) -> wp.vec3:
    """Where the point that a pixel shows was in the last step, in scene units from the frame's origin.

    It is not finite if that is not known.
    """
    i = sums.surfaces.instance[pixel]
    p = sums.surfaces.position[pixel]
    if motion.moving.shape[0] > 0:
        triangle = sums.surfaces.triangle[pixel]
        uv = sums.surfaces.barycentric[pixel]
        weights = wp.vec3(uv[0], uv[1], 1.0 - uv[0] - uv[1])
        moved = wp.vec3(0.0)
        for k in range(3):
            row = scene.indices[3 * triangle + k]
            moving = motion.moving[row]
            if moving >= 0:
                moved += weights[k] * (motion.last_points[moving] - scene.points[row])
        p += scene.instance_axes[i] * moved
    p = p / views.scale
    now = motion.transforms[i]
    last = motion.last_transforms[i]
    if not same_pose(now, last):
        local = wp.transpose(rotation_of(now)) * (p - (wp.transform_get_translation(now) - views.origin))
        p = rotation_of(last) * local + (wp.transform_get_translation(last) - views.origin)
    return p


@wp.func
def last_normal(motion: Motion, sums: ViewSums, pixel: int) -> wp.vec3:
    """The normal of what a pixel shows, as its instance was turned in the last step."""
    i = sums.surfaces.instance[pixel]
    n = sums.surfaces.normal[pixel]
    now = motion.transforms[i]
    last = motion.last_transforms[i]
    if not same_pose(now, last):
        n = rotation_of(last) * (wp.transpose(rotation_of(now)) * n)
    return n


@wp.func
def pixel_that_sees(views: ViewRays, sample: int, start: wp.vec2i, point: wp.vec3) -> wp.vec3:
    """The column and the row, with fractions, of the rays that go through a point in the camera's space; z is 1 if any.

    Rays o + s d are linear between neighbours: o, d and s of the point solve a system of three equations, exactly for a
    pinhole or parallel rays; for others from the pixel that it leads to again.
    """
    column = start[0]
    row = start[1]
    s = float(0.0)
    for _ in range(_MOST_STEPS):
        o = views.rays[row, column, sample, 0]
        d = views.rays[row, column, sample, 1]
        right = wp.where(column + 1 < views.columns, 1, -1)
        down = wp.where(row + 1 < views.rows, 1, -1)
        if views.columns < 2 or views.rows < 2 or wp.length_sq(d) <= 0.0:
            return wp.vec3(0.0)
        d_x = views.rays[row, column + right, sample, 1]
        d_y = views.rays[row + down, column, sample, 1]
        if wp.length_sq(d_x) <= 0.0 or wp.length_sq(d_y) <= 0.0:
            return wp.vec3(0.0)
        v = point - o
        if s <= 0.0:
            s = wp.dot(v, d) / wp.length_sq(d)
        x = (views.rays[row, column + right, sample, 0] - o + s * (d_x - d)) * float(right)
        y = (views.rays[row + down, column, sample, 0] - o + s * (d_y - d)) * float(down)
        determinant = wp.dot(d, wp.cross(x, y))
        solved = wp.dot(v, wp.cross(x, y)) / determinant
        # What is not a number, or behind the camera, ends the search.
        if not (solved > 0.0 and s > 0.0):
            return wp.vec3(0.0)
        # Where all rays begin in one point, offsets are those at `solved`, and not at the s that they were made with.
        dx = wp.dot(d, wp.cross(v, y)) / determinant
        dy = wp.dot(d, wp.cross(x, v)) / determinant
        close = wp.abs(solved - s) < 0.01 * s
        s = solved
        if not (wp.abs(dx) < 1.0e6 and wp.abs(dy) < 1.0e6):
            return wp.vec3(0.0)
        if close and wp.abs(dx) < 0.75 and wp.abs(dy) < 0.75:
            return wp.vec3(float(column) + dx, float(row) + dy, 1.0)
        column = wp.clamp(column + int(wp.round(dx)), 0, views.columns - 1)
        row = wp.clamp(row + int(wp.round(dy)), 0, views.rows - 1)
    return wp.vec3(0.0)


@wp.func
def _tap(x: float, y: float, k: int) -> wp.vec3:
    """The column and the row of the k-th of four pixels around a point, and its bilinear weight."""
    column = wp.floor(x) + float(k % 2)
    row = wp.floor(y) + float(k // 2)
    weight = (1.0 - wp.abs(x - column)) * (1.0 - wp.abs(y - row))
    return wp.vec3(column, row, weight)


@wp.func
def _add_past(past: PastLight, last: LastPictures, pixel: int, q: int, weight: float) -> None:
    """Adds a row of the last pictures to the past of a pixel, with a weight."""
    past.direct[pixel] += weight * last.direct[q]
    past.indirect[pixel] += weight * last.indirect[q]
    past.squares[pixel] += weight * last.squares[q]
    past.local[pixel] += weight * last.local[q]
    if past.square.shape[0] > 0:
        past.radiance[pixel] += weight * last.radiance[q]
        past.square[pixel] += weight * last.square[q]


@wp.func
def _begin_past(past: PastLight, pixel: int) -> None:
    past.count[pixel] = wp.vec2(0.0)
    past.direct[pixel] = wp.vec3(0.0)
    past.indirect[pixel] = wp.vec3(0.0)
    past.squares[pixel] = wp.vec2(0.0)
    past.local[pixel] = wp.vec4(0.0)
    if past.square.shape[0] > 0:
        past.radiance[pixel] = wp.vec3(0.0)
        past.square[pixel] = 0.0


@wp.kernel
def _find_past(
    first: int,
    worlds: wp.array[SceneData],
    views: ViewRays,
    history: ViewHistory,
    motion: Motion,
    last: LastPictures,
    sums: ViewSums,
    past: PastLight,
) -> None:
    """Finds what the surface of a pixel received until the last step."""
    pixel = first + wp.tid()
    view = pixel // (views.rows * views.columns)
    world = views.world[view]
    _begin_past(past, pixel)
    relation = history.relation[view]
    if world < 0 or relation == _NONE or sums.albedo[pixel][3] <= 0.0:
        return
    if relation == _UNCHANGED:
        past.count[pixel] = last.count[pixel]
        _add_past(past, last, pixel, pixel, 1.0)
        return
    begin = view * views.rows * views.columns
    place = pixel - begin
    position = last_position(worlds[world], views, motion, sums, pixel)
    normal = last_normal(motion, sums, pixel)
    camera = history.last_transforms[view]
    from_camera = position - (wp.transform_get_translation(camera) - views.origin)
    point = wp.quat_rotate_inv(wp.transform_get_rotation(camera), from_camera)
    start = wp.vec2i(place % views.columns, place // views.columns)
    at = pixel_that_sees(views, sums.surfaces.sample[pixel], start, point)
    if at[2] == 0.0:
        return
    position *= views.scale
    farthest = _PLANE_DISTANCE * sums.surfaces.footprint[pixel]
    rows = wp.vec4i(-1)
    weights = wp.vec4(0.0)
    total = float(0.0)
    count = wp.vec2(0.0)
    for k in range(4):
        tap = _tap(at[0], at[1], k)
        column = int(tap[0])
        row = int(tap[1])
        if column >= 0 and column < views.columns and row >= 0 and row < views.rows:
            q = begin + row * views.columns + column
            if wp.min(last.count[q]) > 0.0 and last.instance[q] == sums.surfaces.instance[pixel]:
                distance = wp.abs(wp.dot(normal, last.position[q] - position))
                if distance < farthest and wp.dot(normal, last.normal[q]) > _MIN_COSINE:
                    rows[k] = q
                    weights[k] = tap[2]
                    total += tap[2]
                    count += tap[2] * last.count[q]
    if total < _MIN_WEIGHT:
        return
    past.count[pixel] = count / total
    for k in range(4):
        if rows[k] >= 0:
            _add_past(past, last, pixel, rows[k], weights[k] / total)


@wp.func
def _local_light(views: ViewRays, sums: ViewSums, past: PastLight, iterations: int, pixel: int) -> wp.vec4:
    """Means of this step over the pixels around that show the same surface, direct and indirect, and those of the past.

    They are of the mean channels, and over those pixels whose surface has a past.
    """
    begin = pixel - pixel % (views.rows * views.columns)
    column = (pixel - begin) % views.columns
    row = (pixel - begin) // views.columns
    out = wp.vec4(0.0)
    taps = float(0.0)
    for dy in range(-_RADIUS, _RADIUS + 1):
        for dx in range(-_RADIUS, _RADIUS + 1):
            x = column + dx
            y = row + dy
            if x >= 0 and x < views.columns and y >= 0 and y < views.rows:
                q = begin + y * views.columns + x
                same = wp.min(past.count[q]) > 0.0 and sums.surfaces.instance[q] == sums.surfaces.instance[pixel]
                if same and wp.dot(sums.surfaces.normal[q], sums.surfaces.normal[pixel]) > _MIN_COSINE:
                    own = float(iterations) * sums.albedo[q][3] / float(views.samples)
                    now = mean_channels(sums.direct[q], sums.indirect[q]) / own
                    then = mean_channels(past.direct[q], past.indirect[q])
                    out += wp.vec4(now[0], now[1], then[0], then[1])
                    taps += 1.0
    return out / wp.max(taps, 1.0)


@wp.kernel
def _weigh_past(
    first: int, views: ViewRays, history: ViewHistory, iterations: int, most: float, sums: ViewSums, past: PastLight
) -> None:
    """Of how many iterations the past of a pixel counts: of n, unless it differs from the present.

    With a variance v of an iteration and a bias b of the past, the mean of least error has weights as if the past were
    of 1 / (1/n + b²/v) iterations. Both are those of means over the pixels around that show the same surface: v is half
    the mean square of differences from step to step, which light that changes steadily hardly raises, and b² what the
    squared difference of present and past exceeds noise by.
    """
    pixel = first + wp.tid()
    view = pixel // (views.rows * views.columns)
    sums.reused[pixel] = wp.vec2(0.0)
    if views.world[view] < 0 or sums.albedo[pixel][3] <= 0.0:
        return
    own = float(iterations) * sums.albedo[pixel][3] / float(views.samples)
    n = past.count[pixel]
    present = _local_light(views, sums, past, iterations, pixel)
    local = past.local[pixel]
    for k in range(2):
        variance = local[2 + k]
        local[2 + k] = -1.0
        if n[k] > 0.0:
            step = present[k] - local[k]
            local[2 + k] = 0.5 * step * step
            if variance >= 0.0:
                local[2 + k] = variance + (wp.min(local[2 + k], _OUTLIER * variance) - variance) * _RATE
            if history.relation[view] == _MOVED:
                n[k] = wp.min(n[k], most)
                difference = present[k] - present[2 + k]
                bias = difference * difference - _NOISE * variance
                if variance >= 0.0 and bias > 0.0:
                    n[k] = 1.0 / (1.0 / n[k] + bias / wp.max(variance * own, 1.0e-30))
        local[k] = present[k]
    past.local[pixel] = local
    sums.reused[pixel] = n


@wp.kernel
def _continue_views(
    first: int, views: ViewRays, iterations: int, sums: ViewSums, past: PastLight, last: LastPictures
) -> None:
    """Adds the past of a pixel to its sums, and keeps the means for the next step."""
    pixel = first + wp.tid()
    view = pixel // (views.rows * views.columns)
    if views.world[view] < 0:
        return
    hits = sums.albedo[pixel][3]
    last.count[pixel] = wp.vec2(0.0)
    if hits <= 0.0:
        return
    reused = sums.reused[pixel]
    own = float(iterations) * hits / float(views.samples)
    sums.direct[pixel] += reused[0] * past.direct[pixel]
    sums.indirect[pixel] += reused[1] * past.indirect[pixel]
    sums.squares[pixel] += wp.cw_mul(reused, past.squares[pixel])
    n = wp.vec2(own) + reused
    last.count[pixel] = n
    last.instance[pixel] = sums.surfaces.instance[pixel]
    last.position[pixel] = sums.surfaces.position[pixel]
    last.normal[pixel] = sums.surfaces.normal[pixel]
    last.direct[pixel] = sums.direct[pixel] / n[0]
    last.indirect[pixel] = sums.indirect[pixel] / n[1]
    last.squares[pixel] = wp.cw_div(sums.squares[pixel], n)
    last.local[pixel] = past.local[pixel]
    if sums.square.shape[0] > 0:
        sums.radiance[pixel] += wp.min(reused) * past.radiance[pixel]
        sums.square[pixel] += wp.min(reused) * past.square[pixel]
        total = float(iterations) + wp.min(reused)
        last.radiance[pixel] = sums.radiance[pixel] / total
        last.square[pixel] = sums.square[pixel] / total


@wp.kernel
def _keep_points(first: int, rows: wp.array[wp.int32], points: wp.array[wp.vec3], last: wp.array[wp.vec3]) -> None:
    """Copies a point that may move, for the next step."""
    k = first + wp.tid()
    last[k] = points[rows[k]]
