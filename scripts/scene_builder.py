"""Builds a USD stage of diffuse materials, polygon meshes, lights and cameras, as text that is easy to read."""

import math

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from shapes import BOX_FACES, box_points


def rounded(values, digits=5):
    """Python floats, rounded to `digits` decimals, without negative zero."""
    return (np.round(np.asarray(values, dtype=np.float64), digits) + 0.0).tolist()


class Builder:
    """A stage under construction, with the methods that the test scenes need."""

    def __init__(self, doc, meters_per_unit=1.0):
        self.stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(self.stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(self.stage, meters_per_unit)
        layer = self.stage.GetRootLayer()
        layer.documentation = " ".join(doc.split())
        layer.customLayerData = {"license": "CC0-1.0", "source": "scripts/make_scenes.py"}
        self.stage.SetDefaultPrim(UsdGeom.Xform.Define(self.stage, "/World").GetPrim())

    def material(self, name, albedo, emission=None, texture=None):
        """Adds a diffuse material; `texture` names an image in `textures/`, whose mean is then `albedo`."""
        path = Sdf.Path("/World/Looks").AppendChild(name)
        UsdGeom.Scope.Define(self.stage, path.GetParentPath())
        material = UsdShade.Material.Define(self.stage, path)
        surface = UsdShade.Shader.Define(self.stage, path.AppendChild("Surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        diffuse = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        if texture is None:
            diffuse.Set(Gf.Vec3f(*albedo))
        else:
            diffuse.ConnectToSource(self._texture(path, texture, albedo))
        if emission is not None:
            surface.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*emission))
        surface.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(1)
        surface.CreateInput("specularColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.0))
        surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
        material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
        return material

    def _texture(self, path, name, mean):
        """Adds a UsdUVTexture of `textures/<name>.png` that reads the primvar `st`; returns its rgb output."""
        reader = UsdShade.Shader.Define(self.stage, path.AppendChild("St"))
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        texture = UsdShade.Shader.Define(self.stage, path.AppendChild("Texture"))
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./textures/{name}.png")
        texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
        texture.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set("repeat")
        texture.CreateInput("wrapT", Sdf.ValueTypeNames.Token).Set("repeat")
        texture.CreateInput("fallback", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*mean, 1.0))
        st = texture.CreateInput("st", Sdf.ValueTypeNames.Float2)
        st.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
        return texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)

    def bind(self, prim, material):
        """Binds `material` to a prim and its descendants."""
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)

    def mesh(self, path, points, faces, material=None, *, st=None, normals=None, digits=5):
        """Adds a polygon mesh under /World; `faces` are sequences of point indices."""
        mesh = UsdGeom.Mesh.Define(self.stage, f"/World/{path}")
        points = np.asarray(rounded(points, digits))
        mesh.CreatePointsAttr([Gf.Vec3f(*p) for p in points.tolist()])
        mesh.CreateFaceVertexCountsAttr([len(face) for face in faces])
        mesh.CreateFaceVertexIndicesAttr([int(i) for face in faces for i in face])
        mesh.CreateExtentAttr([Gf.Vec3f(*points.min(axis=0)), Gf.Vec3f(*points.max(axis=0))])
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        if normals is not None:
            mesh.CreateNormalsAttr([Gf.Vec3f(*n) for n in rounded(normals, 3)])
            mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if st is not None:
            primvars = UsdGeom.PrimvarsAPI(mesh)
            primvar = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
            primvar.Set([Gf.Vec2f(*uv) for uv in rounded(st)])
        if material is not None:
            self.bind(mesh, material)
        return mesh

    def quad(self, path, corners, material, *, st=None):
        """Adds a quadrilateral; seen from its front the corners run counter-clockwise."""
        return self.mesh(path, corners, [(0, 1, 2, 3)], material, st=st)

    def box(self, path, lower, upper, material=None, *, inward=False, digits=5):
        """Adds an axis-aligned box whose six faces have their front outside, or inside if `inward` is set."""
        faces = BOX_FACES[:, ::-1] if inward else BOX_FACES
        return self.mesh(path, box_points(lower, upper), faces, material, digits=digits)

    def room(self, lower, upper, **materials):
        """Adds a box of six meshes with their front inside.

        `materials` are given by the names left, right, floor, ceiling, back and front, and `other` for the rest.
        """
        points = box_points(lower, upper)
        names = ("left", "right", "floor", "ceiling", "back", "front")
        for name, face in zip(names, BOX_FACES[:, ::-1], strict=True):
            self.quad(f"Room/{name}", points[face], materials.get(name, materials.get("other")))

    def place(self, prim, translate=(0, 0, 0), rotate=(0, 0, 0), scale=None):
        """Authors a transform: scale, then rotations about X, Y and Z [degrees], then the translation."""
        xform = UsdGeom.Xformable(prim)
        xform.AddTranslateOp().Set(Gf.Vec3d(*rounded(translate)))
        if any(rotate):
            xform.AddRotateXYZOp().Set(Gf.Vec3f(*rounded(rotate, 3)))
        if scale is not None:
            xform.AddScaleOp().Set(Gf.Vec3f(*rounded(scale, 3)))
        return prim

    def aim(self, prim, position, target):
        """Places a camera or light at `position`, -Z towards `target`, +Y as close to the up axis as possible."""
        x, y, z = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
        pitch, yaw = math.degrees(math.asin(y)), math.degrees(math.atan2(-x, -z)) if abs(y) < 1 else 0.0
        return self.place(prim, position, (pitch, yaw, 0.0))

    def light(self, schema, name, color, intensity, **inputs):
        """Adds a UsdLux light; `inputs` are named without the prefix `inputs:`."""
        light = schema.Define(self.stage, f"/World/Lights/{name}")
        light.CreateColorAttr(Gf.Vec3f(*rounded(color, 3)))
        light.CreateIntensityAttr(intensity)
        for key, value in inputs.items():
            light.GetPrim().GetAttribute(f"inputs:{key}").Set(value)
        return light

    def camera(
        self,
        position,
        target,
        *,
        name="main_cam",
        focal=24.0,
        aperture=(24.0, 24.0),
        shift=0.0,
        clip=(0.01, 1000.0),
    ):
        """Adds a pinhole camera; only the ratios of aperture and of `shift` (upwards) to the focal length matter."""
        camera = UsdGeom.Camera.Define(self.stage, f"/World/{name}")
        camera.CreateFocalLengthAttr(focal)
        camera.CreateHorizontalApertureAttr(aperture[0])
        camera.CreateVerticalApertureAttr(aperture[1])
        if shift:
            camera.CreateVerticalApertureOffsetAttr(shift)
        camera.CreateClippingRangeAttr(Gf.Vec2f(*clip))
        return self.aim(camera, position, target)
