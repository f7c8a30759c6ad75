"""UsdSkel: meshes deformed by blend shapes and skeletons at the moment that is rendered.

The stage is only asked (`BakeSkinning` would write to it, and skips instances). USD resolves skeletons, animations and
blend shape weights; what a file can get wrong (indices, lengths) is checked here before it is used.
"""

from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from warp_ir.scene import Floats, Ints
from warp_ir.usd.values.report import Report, Unreadable

_DRAWN = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)


@dataclass(frozen=True, eq=False)
class Pose:
    """A mesh as its skeleton and its blend shapes deform it, in the mesh's own space."""

    points: Floats
    """float64 [n, 3]."""
    added: Floats | None
    """What blend shapes add to the normal of each point, float64 [n, 3]."""
    turned: Floats | None
    """How the skeleton turns normals: rows times matrices, float64 [n, 3, 3]."""

    def normals(self, normals: Floats, triangles: Ints) -> Floats:
        """The deformed normals of the corners [m, 3, 3] at the points that the triangles [m, 3] name."""
        if self.added is not None:
            normals = normals + self.added[triangles]
        return normals if self.turned is None else np.einsum("mci,mcij->mcj", normals, self.turned[triangles])


def is_bound(prim: Usd.Prim) -> bool:
    """Whether a prim may be deformed."""
    return bool(prim.HasAPI(UsdSkel.BindingAPI))


def sharing_key(prim: Usd.Prim) -> tuple[Sdf.Path, ...]:
    """What tells the poses of a prototype's prim apart: where in the prototype its skeleton and its animation are.

    If they are elsewhere, every instance has a pose of its own.
    """
    if not is_bound(prim) or not prim.IsInstanceProxy():
        return ()
    skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
    if not skeleton:
        return ()
    home = prim.GetPrimInPrototype().GetPath().GetPrefixes()[0]
    key = []
    for source in (skeleton.GetPrim(), UsdSkel.BindingAPI(skeleton.GetPrim()).GetInheritedAnimationSource()):
        if source:
            shared = source.GetPrimInPrototype().GetPath() if source.IsInstanceProxy() else source.GetPath()
            if not shared.HasPrefix(home):
                return (prim.GetPath(),)
            key.append(shared)
    return tuple(key)


class Skinning:
    """The poses of a stage's meshes.

    Args:
        time: Of the poses.
        report: Where troubles go.
    """

    def __init__(self, time: Usd.TimeCode, report: Report) -> None:
        self._time, self._report = time, report
        self._cache: UsdSkel.Cache | None = None
        self._roots: set[Sdf.Path] = set()
        self._transforms = UsdGeom.XformCache(time)

    def pose(self, prim: Usd.Prim, points: Floats) -> Pose | None:
        """The deformed mesh; None if nothing deforms it, or if that cannot be evaluated: then it keeps its rest pose.

        Args:
            prim: A mesh.
            points: Its points at rest, float64 [n, 3].
        """
        if not is_bound(prim):
            return None
        try:
            return self._pose(prim, points)
        except Unreadable as trouble:
            self._report.warn(prim.GetPath(), f"{trouble}; the mesh is in its rest pose ({{n}} in all)")
            return None

    def _pose(self, prim: Usd.Prim, points: Floats) -> Pose | None:
        query = self._query(prim)
        if query is None or not (query.HasJointInfluences() or query.HasBlendShapes()):
            return None
        assert self._cache is not None
        skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
        if not skeleton:
            raise Unreadable("it is bound to no skeleton")
        bones = self._cache.GetSkelQuery(skeleton)
        if not bones:
            raise Unreadable(f"its skeleton {skeleton.GetPath()} is not valid")
        added = None
        if query.HasBlendShapes():
            points, added = self._blended(prim, query, bones, points)
        if not query.HasJointInfluences():
            return Pose(points, added, None)
        return self._skinned(prim, query, bones, points, added)

    def _query(self, prim: Usd.Prim) -> UsdSkel.SkinningQuery | None:
        """What USD knows about the prim's binding; None if it is not below a SkelRoot, where nothing is deformed."""
        root = UsdSkel.Root.Find(prim)
        if not root:
            return None
        if self._cache is None:
            self._cache = UsdSkel.Cache()
        if root.GetPath() not in self._roots:
            self._roots.add(root.GetPath())
            self._cache.Populate(root, _DRAWN)
        query = self._cache.GetSkinningQuery(prim)
        return query if query else None

    def _blended(
        self, prim: Usd.Prim, query: UsdSkel.SkinningQuery, bones: UsdSkel.SkeletonQuery, points: Floats
    ) -> tuple[Floats, Floats | None]:
        """The points with their blend shapes, and what those add to the normals."""
        animation = bones.GetAnimQuery()
        weights = animation.ComputeBlendShapeWeights(self._time) if animation else None
        if not weights:
            return points, None
        mapper = query.GetBlendShapeMapper()
        if mapper is not None and not mapper.IsIdentity():
            weights = mapper.Remap(weights)
        if not weights or not np.isfinite(np.asarray(weights)).all():
            raise Unreadable("its blend shape weights cannot be evaluated")
        shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim))
        if len(weights) != shapes.GetNumBlendShapes():
            raise Unreadable(f"there are {len(weights)} weights for {shapes.GetNumBlendShapes()} blend shapes")
        active = shapes.ComputeSubShapeWeights(weights)
        offsets, indices = shapes.ComputeSubShapePointOffsets(), shapes.ComputeBlendShapePointIndices()
        points, added = points.copy(), np.zeros_like(points)
        for weight, shape, subshape in zip(*(np.asarray(a).tolist() for a in active), strict=True):
            where = np.asarray(indices[shape], dtype=np.int64)
            between, whole = shapes.GetInbetween(subshape), shapes.GetBlendShape(shape)
            if not whole:
                raise Unreadable(f"blend shape {shape} does not exist")
            normals = between.GetNormalOffsets() if between else whole.GetNormalOffsetsAttr().Get()
            for target, given in ((points, offsets[subshape]), (added, normals)):
                offset = np.asarray(given if given is not None else [], dtype=np.float64).reshape(-1, 3)
                if len(offset) == 0:
                    continue
                which = where if len(where) else np.arange(len(points))
                if len(which) != len(offset) or which.min() < 0 or which.max() >= len(points):
                    raise Unreadable(f"blend shape {shape} has {len(offset)} offsets that do not fit the points")
                np.add.at(target, which, weight * offset)
        return points, added if added.any() else None

    def _skinned(
        self,
        prim: Usd.Prim,
        query: UsdSkel.SkinningQuery,
        bones: UsdSkel.SkeletonQuery,
        points: Floats,
        added: Floats | None,
    ) -> Pose:
        """The points as the skeleton moves them, by linear blending or with dual quaternions."""
        binds = bones.GetSkeleton().GetBindTransformsAttr().Get()
        if not isinstance(binds, Vt.Matrix4dArray) or len(binds) != len(bones.GetJointOrder()):
            # USD itself would take what is not there.
            raise Unreadable(f"its skeleton {bones.GetPrim().GetPath()} has not one bind transform for each joint")
        joints = bones.ComputeSkinningTransforms(self._time)
        mapper = query.GetJointMapper()
        if joints and mapper is not None and not mapper.IsIdentity():
            joints = mapper.RemapTransforms(joints)
        if not joints or not np.isfinite(np.asarray(joints)).all():
            raise Unreadable(f"its skeleton {bones.GetPrim().GetPath()} cannot be evaluated")
        influences = query.ComputeVaryingJointInfluences(len(points), self._time)
        count = query.GetNumInfluencesPerComponent()
        if not influences or count < 1 or any(len(a) != count * len(points) for a in influences):
            raise Unreadable("its joint indices and weights do not fit its points")
        index, weight = (np.asarray(a).reshape(len(points), count) for a in influences)
        if index.min(initial=0) < 0 or index.max(initial=0) >= len(joints):
            raise Unreadable(f"a joint index is out of range, there are {len(joints)} joints")
        if not np.isfinite(weight).all():
            raise Unreadable("a joint weight is NaN or infinite")
        bind, back = query.GetGeomBindTransform(self._time), self._mesh_from_skeleton(prim)
        if not (np.isfinite(np.asarray(bind)).all() and np.isfinite(np.asarray(back)).all()):
            raise Unreadable("its bind transform is NaN or infinite")
        if query.GetSkinningMethod() == UsdSkel.Tokens.dualQuaternion:
            flat = [Vt.IntArray.FromNumpy(index.reshape(-1).astype(np.int32))]
            flat += [Vt.FloatArray.FromNumpy(weight.reshape(-1).astype(np.float32))]
            moved, turned = _by_dual_quaternions(bind, joints, flat, count, points)
            outer = np.asarray(back)
            return Pose(moved @ outer[:3, :3] + outer[3, :3], added, turned @ _normal_matrices(outer[None, :3, :3]))
        matrices = np.asarray(bind) @ np.asarray(joints) @ np.asarray(back)  # rows times matrices, from mesh to mesh
        moved = np.zeros_like(points)
        turned = np.zeros((len(points), 3, 3))
        normal_matrices = _normal_matrices(matrices[:, :3, :3])
        for k in range(count):
            share, of = weight[:, k : k + 1].astype(np.float64), index[:, k]
            moved += share * (np.einsum("ni,nij->nj", points, matrices[of, :3, :3]) + matrices[of, 3, :3])
            turned += share[:, :, None] * normal_matrices[of]
        return Pose(moved, added, turned)

    def _mesh_from_skeleton(self, prim: Usd.Prim) -> Gf.Matrix4d:
        """From the space of the skeleton, where it poses meshes, to that of the mesh."""
        mesh = self._transforms.GetLocalToWorldTransform(prim)
        if not abs(mesh.GetDeterminant()) > 0.0:
            raise Unreadable("its transform is singular")
        # The query's own prim may be the prototype's, which is nowhere.
        skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton().GetPrim()
        return self._transforms.GetLocalToWorldTransform(skeleton) * mesh.GetInverse()


def _by_dual_quaternions(
    bind: Gf.Matrix4d,
    joints: Vt.Matrix4dArray,
    influences: list[Vt.IntArray | Vt.FloatArray],
    count: int,
    points: Floats,
) -> tuple[Floats, Floats]:
    """Points [n, 3] in the skeleton's space, and the matrices [n, 3, 3] that turn their normals there."""
    method = UsdSkel.Tokens.dualQuaternion
    moved = Vt.Vec3fArray.FromNumpy(points.astype(np.float32))
    if not UsdSkel.SkinPoints(method, bind, joints, *influences, count, moved):
        raise Unreadable("its dual quaternions cannot be evaluated")
    bind3 = bind.ExtractRotationMatrix().GetInverse().GetTranspose()
    joints3 = Vt.Matrix3dArray([j.ExtractRotationMatrix().GetInverse().GetTranspose() for j in joints])
    rows = []
    for axis in np.eye(3, dtype=np.float32):
        row = Vt.Vec3fArray.FromNumpy(np.tile(axis, (len(points), 1)))
        if not UsdSkel.SkinNormals(method, bind3, joints3, *influences, count, row):
            raise Unreadable("its dual quaternions cannot be evaluated")
        rows.append(np.asarray(row, dtype=np.float64))
    return np.asarray(moved, dtype=np.float64), np.stack(rows, axis=1)


def _normal_matrices(matrices: Floats) -> Floats:
    """The inverse transposes of matrices [k, 3, 3]; of flat ones the cofactors, which point the same way."""
    a, b, c = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = np.einsum("ki,ki->k", a, cofactors[:, 0])
    scaled: Floats = cofactors / np.where(volume != 0.0, volume, 1.0)[:, None, None]
    return scaled
