"""UsdSkel: meshes deformed by blend shapes and skeletons at the time that is rendered.

The stage is not modified (`BakeSkinning` would write to it, and skips instances). USD resolves skeletons, animations
and blend shape weights; indices and array lengths, which files get wrong, are validated here before use.
"""

from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from warp_ir.scene import Floats, Ints
from warp_ir.usd.values import read
from warp_ir.usd.values.report import Report, Unreadable

_RENDERED = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)


@dataclass(frozen=True, eq=False)
class DeformedMesh:
    """A mesh deformed by its blend shapes and its skeleton, in the mesh's own space."""

    points: Floats
    """float64 [n, 3]."""
    normal_offsets: Floats | None
    """Sum of the blend shapes' normal offsets at each point, float64 [n, 3]; None: no offsets."""
    normal_matrices: Floats | None
    """Transforms of each point's normal, a row vector, by the skeleton, float64 [n, 3, 3]; None: no skeleton."""

    def normals(self, normals: Floats, triangles: Ints) -> Floats:
        """Deformed normals [m, 3, 3] at the corners of the triangles [m, 3]."""
        if self.normal_offsets is not None:
            normals = normals + self.normal_offsets[triangles]
        if self.normal_matrices is None:
            return normals
        deformed: Floats = np.einsum("mci,mcij->mcj", normals, self.normal_matrices[triangles])
        return deformed


def is_bound(prim: Usd.Prim) -> bool:
    """Whether a prim has SkelBindingAPI applied."""
    return bool(prim.HasAPI(UsdSkel.BindingAPI))


def pose_key(prim: Usd.Prim) -> tuple[Sdf.Path, ...]:
    """A key that is equal for instances of a prototype's prim with the same pose.

    It holds the paths of skeleton and animation if both are in the prototype. If they are outside of it, every instance
    can have a pose of its own, and the key is its path.
    """
    if not is_bound(prim) or not prim.IsInstanceProxy():
        return ()
    skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
    if not skeleton:
        return ()
    prototype = prim.GetPrimInPrototype().GetPath().GetPrefixes()[0]
    key = []
    for source in (skeleton.GetPrim(), UsdSkel.BindingAPI(skeleton.GetPrim()).GetInheritedAnimationSource()):
        if source:
            path = source.GetPrimInPrototype().GetPath() if source.IsInstanceProxy() else source.GetPath()
            if not path.HasPrefix(prototype):
                return (prim.GetPath(),)
            key.append(path)
    return tuple(key)


class Skinning:
    """Deforms the meshes of a stage by UsdSkel.

    Args:
        time: Time at which animation is evaluated.
        report: Receives warnings.
    """

    def __init__(self, time: Usd.TimeCode, report: Report) -> None:
        self._time, self._report = time, report
        self._cache: UsdSkel.Cache | None = None
        self._roots: set[Sdf.Path] = set()
        self._transforms = UsdGeom.XformCache(time)

    def deform(self, prim: Usd.Prim, points: Floats) -> DeformedMesh | None:
        """The deformed mesh; None if nothing deforms it or, with a warning, if its deformation cannot be evaluated.

        Args:
            prim: A mesh.
            points: Its points in the rest pose, float64 [n, 3].
        """
        if not is_bound(prim):
            return None
        try:
            return self._deform(prim, points)
        except Unreadable as error:
            self._report.warn(prim.GetPath(), f"{error}; the mesh is in its rest pose ({{n}} in all)")
            return None

    def _deform(self, prim: Usd.Prim, points: Floats) -> DeformedMesh | None:
        query = self._skinning_query(prim)
        if query is None or not (query.HasJointInfluences() or query.HasBlendShapes()):
            return None
        assert self._cache is not None
        skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
        if not skeleton:
            raise Unreadable("it is bound to no skeleton")
        skeleton_query = self._cache.GetSkelQuery(skeleton)
        if not skeleton_query:
            raise Unreadable(f"its skeleton {skeleton.GetPath()} is not valid")
        offsets = None
        if query.HasBlendShapes():
            points, offsets = self._apply_blend_shapes(prim, query, skeleton_query, points)
        if not query.HasJointInfluences():
            return DeformedMesh(points, offsets, None)
        return self._apply_skeleton(prim, query, skeleton_query, points, offsets)

    def _skinning_query(self, prim: Usd.Prim) -> UsdSkel.SkinningQuery | None:
        """USD's query for a prim's binding; None if the prim is not below a SkelRoot and so is not deformed."""
        root = UsdSkel.Root.Find(prim)
        if not root:
            return None
        if self._cache is None:
            self._cache = UsdSkel.Cache()
        if root.GetPath() not in self._roots:
            self._roots.add(root.GetPath())
            self._cache.Populate(root, _RENDERED)
        query = self._cache.GetSkinningQuery(prim)
        return query if query else None

    def _apply_blend_shapes(
        self, prim: Usd.Prim, query: UsdSkel.SkinningQuery, skeleton: UsdSkel.SkeletonQuery, points: Floats
    ) -> tuple[Floats, Floats | None]:
        """The points with weighted offsets of their blend shapes, and the sum of the normal offsets."""
        animation = skeleton.GetAnimQuery()
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
        points, normal_offsets = points.copy(), np.zeros_like(points)
        for weight, shape, subshape in zip(*(np.asarray(a).tolist() for a in active), strict=True):
            authored = np.asarray(indices[shape], dtype=np.int64)
            inbetween, blend_shape = shapes.GetInbetween(subshape), shapes.GetBlendShape(shape)
            if not blend_shape:
                raise Unreadable(f"blend shape {shape} does not exist")
            of_normals = inbetween.GetNormalOffsetsAttr() if inbetween else blend_shape.GetNormalOffsetsAttr()
            normals = read.floats(of_normals, Usd.TimeCode.Default(), 3)
            for target, values in ((points, offsets[subshape]), (normal_offsets, normals)):
                if values is None or not len(values):
                    continue
                offset = np.asarray(values, dtype=np.float64)
                index = authored if len(authored) else np.arange(len(points))
                if len(index) != len(offset) or index.min() < 0 or index.max() >= len(points):
                    raise Unreadable(f"blend shape {shape} has {len(offset)} offsets that do not fit the points")
                np.add.at(target, index, weight * offset)
        return points, normal_offsets if normal_offsets.any() else None

    def _apply_skeleton(
        self,
        prim: Usd.Prim,
        query: UsdSkel.SkinningQuery,
        skeleton: UsdSkel.SkeletonQuery,
        points: Floats,
        normal_offsets: Floats | None,
    ) -> DeformedMesh:
        """The mesh deformed by its skeleton, by linear blend or dual quaternion skinning."""
        binds = skeleton.GetSkeleton().GetBindTransformsAttr().Get()
        if not isinstance(binds, Vt.Matrix4dArray) or len(binds) != len(skeleton.GetJointOrder()):
            # USD does not check this and would read beyond the array.
            raise Unreadable(f"its skeleton {skeleton.GetPrim().GetPath()} has not one bind transform for each joint")
        joints = skeleton.ComputeSkinningTransforms(self._time)
        mapper = query.GetJointMapper()
        if joints and mapper is not None and not mapper.IsIdentity():
            # Joints of the mesh that the skeleton lacks become the identity, as in USD's own skinning.
            joints = mapper.RemapTransforms(joints, Vt.Matrix4dArray())
        if not joints or not np.isfinite(np.asarray(joints)).all():
            raise Unreadable(f"its skeleton {skeleton.GetPrim().GetPath()} cannot be evaluated")
        influences = query.ComputeVaryingJointInfluences(len(points), self._time)
        count = query.GetNumInfluencesPerComponent()
        if not influences or count < 1 or any(len(a) != count * len(points) for a in influences):
            raise Unreadable("its joint indices and weights do not fit its points")
        index, weight = (np.asarray(a).reshape(len(points), count) for a in influences)
        if index.min(initial=0) < 0 or index.max(initial=0) >= len(joints):
            raise Unreadable(f"a joint index is out of range, there are {len(joints)} joints")
        if not np.isfinite(weight).all():
            raise Unreadable("a joint weight is NaN or infinite")
        bind, mesh_from_skeleton = query.GetGeomBindTransform(self._time), self._mesh_from_skeleton(prim)
        if not (np.isfinite(np.asarray(bind)).all() and np.isfinite(np.asarray(mesh_from_skeleton)).all()):
            raise Unreadable("its bind transform is NaN or infinite")
        if query.GetSkinningMethod() == UsdSkel.Tokens.dualQuaternion:
            influence_arrays = [Vt.IntArray.FromNumpy(index.reshape(-1).astype(np.int32))]
            influence_arrays += [Vt.FloatArray.FromNumpy(weight.reshape(-1).astype(np.float32))]
            skinned, normal_matrices = _skin_dual_quaternion(bind, joints, influence_arrays, count, points)
            outer = np.asarray(mesh_from_skeleton)
            normal_matrices = normal_matrices @ _inverse_transposes(outer[None, :3, :3])
            return DeformedMesh(skinned @ outer[:3, :3] + outer[3, :3], normal_offsets, normal_matrices)
        # For row vectors, from the mesh's space by way of the skeleton's back to the mesh's.
        matrices = np.asarray(bind) @ np.asarray(joints) @ np.asarray(mesh_from_skeleton)
        skinned = np.zeros_like(points)
        normal_matrices = np.zeros((len(points), 3, 3))
        inverse_transposes = _inverse_transposes(matrices[:, :3, :3])
        for k in range(count):
            w, joint = weight[:, k : k + 1].astype(np.float64), index[:, k]
            skinned += w * (np.einsum("ni,nij->nj", points, matrices[joint, :3, :3]) + matrices[joint, 3, :3])
            normal_matrices += w[:, :, None] * inverse_transposes[joint]
        return DeformedMesh(skinned, normal_offsets, normal_matrices)

    def _mesh_from_skeleton(self, prim: Usd.Prim) -> Gf.Matrix4d:
        """The transform from the skeleton's space, in which meshes are skinned, to the mesh's."""
        mesh = self._transforms.GetLocalToWorldTransform(prim)
        if not abs(mesh.GetDeterminant()) > 0.0:
            raise Unreadable("its transform is singular")
        # The query's prim may be in a prototype, which has no transform to world space.
        skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton().GetPrim()
        return self._transforms.GetLocalToWorldTransform(skeleton) * mesh.GetInverse()


def _skin_dual_quaternion(
    bind: Gf.Matrix4d,
    joints: Vt.Matrix4dArray,
    influences: list[Vt.IntArray | Vt.FloatArray],
    count: int,
    points: Floats,
) -> tuple[Floats, Floats]:
    """Skinned points [n, 3] in the skeleton's space, and the matrices [n, 3, 3] of their normals (row vectors)."""
    method = UsdSkel.Tokens.dualQuaternion
    skinned = Vt.Vec3fArray.FromNumpy(points.astype(np.float32))
    if not UsdSkel.SkinPoints(method, bind, joints, *influences, count, skinned):
        raise Unreadable("its dual quaternions cannot be evaluated")
    bind3 = bind.ExtractRotationMatrix().GetInverse().GetTranspose()
    joints3 = Vt.Matrix3dArray([j.ExtractRotationMatrix().GetInverse().GetTranspose() for j in joints])
    rows = []
    for axis in np.eye(3, dtype=np.float32):
        row = Vt.Vec3fArray.FromNumpy(np.tile(axis, (len(points), 1)))
        if not UsdSkel.SkinNormals(method, bind3, joints3, *influences, count, row):
            raise Unreadable("its dual quaternions cannot be evaluated")
        rows.append(np.asarray(row, dtype=np.float64))
    return np.asarray(skinned, dtype=np.float64), np.stack(rows, axis=1)


def _inverse_transposes(matrices: Floats) -> Floats:
    """Inverse transposes of matrices [k, 3, 3]; cofactor matrices, which are proportional, of singular ones."""
    a, b, c = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    cofactor = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    determinant = np.einsum("ki,ki->k", a, cofactor[:, 0])
    result: Floats = cofactor / np.where(determinant != 0.0, determinant, 1.0)[:, None, None]
    return result
