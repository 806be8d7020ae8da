"""Readers and writers of files.

Modules, imported by name (``import reli3d.io.glb``):

- meshes: glb writes, gltf, gltf_materials and gltf_parts read; obj and usd write
- images: images, hdr, exr, rgbe
- files: checks of files, and writing of whole files or none
"""
