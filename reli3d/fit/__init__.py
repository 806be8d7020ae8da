"""Fitting of surface, material and lighting to posed images by inverse rendering.

Modules, imported by name (``import reli3d.fit.maps``):

- stages: refine (all but the last), shape, material_start, maps, lighting, fine_detail
- data: input_images, background, view_colors, bounce, light_frame, light_hue
- parts: losses, unknowns, fields, choice, budget, facets, transfer
"""
