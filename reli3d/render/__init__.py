"""Rendering with environment lighting and metallic-roughness materials.

Modules, imported by name (``import reli3d.render.shading``):

- images: image, gbuffer, silhouette, volume, color
- materials: asset, points, material, bump, sampling
- lighting: environment, latlong, lights, gaussians, shading, allocation, transfer, exposure
"""
