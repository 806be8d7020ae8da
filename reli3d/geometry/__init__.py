"""Meshes, cameras, ray casting, surface extraction and UV atlases.

Modules, imported by name (``import reli3d.geometry.rays``):

- meshes: mesh, topology, normals, smooth, regularize, decimate, distance, tangents
- cameras and images: camera, projection, visibility, hull, symmetry, cover
- rays: rays, hits, embree
- surfaces from fields: surface, grid, sparse_sdf, triplane
- textures: uv, charts, bake
"""
