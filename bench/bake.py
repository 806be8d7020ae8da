"""Texels of an atlas, dilation against scipy's distance transform, a bake with its normal map, and the GLB."""

import torch
import trimesh
from scipy import ndimage

from reli3d.geometry.bake import bake, nearest_valid, rasterize_texels
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.tangents import encode_normals
from reli3d.geometry.uv import unwrap
from reli3d.io.glb import glb_bytes
from reli3d.render.asset import Asset, TextureSet


def sphere(device, subdivisions, size) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions)
    mesh = Mesh(torch.tensor(ball.vertices, dtype=torch.float32), torch.tensor(ball.faces, dtype=torch.int32))
    return unwrap(mesh, texture_size=size).with_tangents().to(device)


def colors(p, n, t):
    rough, metal = 0.5 + 0.2 * p[:, 1:2], 0.5 + 0.2 * p[:, 2:]
    return {
        "base_color": 0.5 + 0.4 * torch.sin(5 * p),
        "roughness": rough,
        "metallic": metal,
        "normal": encode_normals(n, n, t),
    }


def texels(device, subdivisions, size):
    """Face and barycentrics of every texel."""
    mesh = sphere(device, subdivisions, size)
    return lambda: rasterize_texels(mesh, size), {"texels": size * size}


def nearest(device, subdivisions, size):
    """Nearest valid texel of every texel."""
    valid = rasterize_texels(sphere(device, subdivisions, size), size).valid
    return lambda: nearest_valid(valid), {"texels": size * size}


def scipy_nearest(device, subdivisions, size):
    valid = ~rasterize_texels(sphere("cpu", subdivisions, size), size).valid.numpy()
    return lambda: ndimage.distance_transform_edt(valid, return_indices=True), {"texels": size * size}


def whole(device, subdivisions, size):
    """Texels, three maps of a cheap function, dilation."""
    mesh = sphere(device, subdivisions, size)
    return lambda: bake(mesh, size, colors, tangents=True), {"texels": size * size}


def tangents(device, subdivisions, size):
    mesh = sphere(device, subdivisions, size)
    return lambda: mesh.with_tangents().tangents, {"faces": len(mesh.faces)}


def glb(device, subdivisions, size):
    """The file in memory: three PNG, geometry, JSON."""
    mesh = sphere(device, subdivisions, size)
    asset = Asset(mesh, TextureSet(**bake(mesh, size, colors, tangents=True)))
    return lambda: glb_bytes(asset), {"texels": 3 * size * size}


_SIZE = dict(subdivisions=5, size=1024)
CASES = {"texels": (texels, _SIZE), "nearest": (nearest, _SIZE), "bake": (whole, _SIZE)}
CASES |= {"tangents": (tangents, _SIZE), "glb": (glb, _SIZE)}
PEERS = {"nearest": ("scipy", scipy_nearest)}
