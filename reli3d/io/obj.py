"""Writes Wavefront OBJ, with the metallic-roughness keywords that Blender and others read from a material file.

The keywords ``map_Pr``, ``map_Pm`` and ``norm`` are from the PBR extension
(http://exocortex.com/blog/extending_wavefront_mtl_to_support_pbr).  Blender writes and reads ``Ks 0.5`` for a
dielectric of refractive index 1.5; without it, Blender shows no specular reflection.
"""

import io

import numpy as np

from reli3d._bridge import present
from reli3d.io.glb import check_portable, encode_image
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb

MATERIAL = """newmtl baked
Kd 1 1 1
Ks 0.5 0.5 0.5
map_Kd {name}_base_color.png
map_Pr {name}_roughness.png
map_Pm {name}_metallic.png
norm {name}_normal.png
"""


def obj_files(asset: Asset, name: str) -> dict[str, bytes]:
    """Files by name: ``NAME.obj``, ``NAME.mtl`` and four PNG textures.

    A corner uses one index for position, normal and texture coordinate.  v is flipped because it points up in OBJ.
    Raises TypeError or ValueError as :func:`reli3d.write_glb`, and ValueError for vertex colors or UV outside [0, 1]
    that do not repeat.
    """
    check_portable(asset)
    mesh, textures = asset.mesh, asset.textures
    text = io.StringIO()
    text.write(f"mtllib {name}.mtl\no object\n")
    uv = present("uv", mesh.uv).detach().cpu().double().numpy() * (1, -1) + (0, 1)
    vertices, normals = (t.detach().cpu().numpy() for t in (mesh.vertices, present("normals", mesh.normals)))
    for word, values in (("v", vertices), ("vn", normals), ("vt", uv)):
        np.savetxt(text, values, fmt=" ".join([word, *["%.9g"] * values.shape[1]]))
    text.write("usemtl baked\n")
    corners = np.repeat(mesh.faces.cpu().numpy() + 1, 3, axis=1)
    np.savetxt(text, corners, fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")
    gray = {k: getattr(textures, k)[..., None].expand(-1, -1, 3) for k in ("roughness", "metallic")}
    maps = {"base_color": linear_to_srgb(textures.base_color), **gray, "normal": textures.normal}
    return {
        f"{name}.obj": text.getvalue().encode(),
        f"{name}.mtl": MATERIAL.format(name=name).encode(),
        **{f"{name}_{k}.png": encode_image(v) for k, v in maps.items()},
    }
