"""Writes USDZ with Pixar's USD library (``usd-core``), an optional dependency: one mesh with a UsdPreviewSurface."""

import tempfile
from pathlib import Path

import numpy as np

from reli3d._bridge import present
from reli3d.geometry.mesh import watertight
from reli3d.io.glb import addressing, check_portable, texture_images
from reli3d.render.asset import Asset


def usdz_bytes(asset: Asset) -> bytes:
    """A USDZ package: +Y up, meters, textures as PNG.  Raises ImportError without ``usd-core``, otherwise as glTF.

    Roughness and metallic are channels of one texture, as in glTF; texture coordinates have v up, as in USD.
    """
    check_portable(asset)
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt
    except ModuleNotFoundError as error:
        raise ImportError("usd-core is not installed: pip install 'reli3d[usd]'", name="pxr") from error
    mesh = asset.mesh
    with tempfile.TemporaryDirectory() as folder:
        for k, data in texture_images(asset).items():
            (Path(folder) / f"{k}.png").write_bytes(data)
        stage = Usd.Stage.CreateNew(str(Path(folder) / "object.usdc"))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/object")
        stage.SetDefaultPrim(root.GetPrim())
        shape = UsdGeom.Mesh.Define(stage, "/object/mesh")
        arrays = mesh.vertices, present("normals", mesh.normals), present("uv", mesh.uv)
        points, normals, uv = (np.ascontiguousarray(t.detach().cpu().numpy()) for t in arrays)
        faces = np.ascontiguousarray(mesh.faces.cpu().numpy())
        shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
        shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1)))
        shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
        shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        shape.CreateDoubleSidedAttr(not watertight(mesh))
        st = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
        up = uv * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)
        st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(up)))

        material = UsdShade.Material.Define(stage, "/object/material")
        reader = _shader(stage, "st", "UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        surface = _shader(stage, "surface", "UsdPreviewSurface")
        wrap = addressing(asset)
        base = _texture(stage, reader, "base_color", "sRGB", wrap)
        packed = _texture(stage, reader, "metallic_roughness", "raw", wrap)
        normal = _texture(stage, reader, "normal", "raw", wrap)
        normal.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
        normal.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        for slot, kind, source, channel in (
            ("diffuseColor", Sdf.ValueTypeNames.Color3f, base, "rgb"),
            ("roughness", Sdf.ValueTypeNames.Float, packed, "g"),
            ("metallic", Sdf.ValueTypeNames.Float, packed, "b"),
            ("normal", Sdf.ValueTypeNames.Normal3f, normal, "rgb"),
        ):
            surface.CreateInput(slot, kind).ConnectToSource(source.ConnectableAPI(), channel)
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
        stage.Save()
        package = Path(folder) / "object.usdz"
        if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(stage.GetRootLayer().realPath), str(package)):
            raise OSError(f"{package.name}: USD could not write the package")
        return package.read_bytes()


def _shader(stage, name: str, kind: str):
    from pxr import UsdShade

    shader = UsdShade.Shader.Define(stage, f"/object/material/{name}")
    shader.CreateIdAttr(kind)
    return shader


def _texture(stage, reader, name: str, space: str, wrap: tuple[str, str]):
    """Shader that reads ``NAME.png`` with the texture coordinates of ``reader``."""
    from pxr import Sdf

    shader = _shader(stage, name, "UsdUVTexture")
    shader.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(f"./{name}.png"))
    shader.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(space)
    for side, mode in zip(("wrapS", "wrapT"), wrap):
        shader.CreateInput(side, Sdf.ValueTypeNames.Token).Set(mode)
    shader.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    for channel in ("rgb", "g", "b"):
        shader.CreateOutput(channel, Sdf.ValueTypeNames.Float3 if channel == "rgb" else Sdf.ValueTypeNames.Float)
    return shader
