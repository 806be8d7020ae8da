"""The published checkpoint's names in ours: one table, and the one rule for parameters that it stores twice.

A name keeps its tail; only the front changes, by the first row that fits.  The published model registered the camera
modulation of every encoder layer a second time under ``modulations``: index 2i is the first norm of layer i, 2i + 1 the
second.
"""

import re

CHECKPOINT_PREFIX = "system."  # of the training system, before every name below

KEY_MAP = (  # published, ours
    ("preprocessor.1.", "camera."),
    ("tokenizer.0.", "encoder."),
    ("tokenizer.1.", "bank."),
    ("backbone.", "backbone."),
    ("postprocessor.0.", "upsampler."),
    ("postprocessor.1.tokenizer.0.tokenizer.", "illumination.encoder."),
    ("postprocessor.1.tokenizer.1.", "illumination.bank."),
    ("postprocessor.1.tokenizer.2.", "illumination.plane_tokens."),
    ("postprocessor.1.backbone.", "illumination.transformer."),
    ("postprocessor.3.reni_env.", "environment."),
    ("object_representation.net.heads.density.", "heads.density."),
    ("object_representation.net.heads.basecolor.", "heads.base_color."),
    ("object_representation.net.heads.surface-normal.", "heads.normal."),
    ("object_representation.net.heads.vertex-offset.", "heads.deformation."),
    ("object_representation.net.heads.roughness.", "heads.roughness."),
    ("object_representation.net.heads.metallic.", "heads.metallic."),
    ("object_representation.net.heads.flexicubes-weight.", "heads.flexicubes."),
    ("object_representation.indices_merging_mlp.heads.flexicubes-weight.", "merger.mlp."),
)
UNUSED = "material.tone_mapping."  # constants of an identity, which have no effect in the published model either
_ALIAS = re.compile(r"(encoder\.)modulations\.(\d+)\.")


def our_key(published: str) -> str | None:
    """Our name of a published parameter, ``system.`` already taken off; None where the table has no row for it."""
    for theirs, ours in KEY_MAP:
        if published.startswith(theirs):
            return _ALIAS.sub(_modulation, ours + published[len(theirs) :])
    return None


def _modulation(match: re.Match) -> str:
    index = int(match[2])
    return f"{match[1]}model.encoder.layer.{index // 2}.norm{1 + index % 2}_modulation."
