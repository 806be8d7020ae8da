"""The published checkpoint's names in ours.

A name keeps its tail.  ``modulations`` 2i and 2i + 1 are those of the norms of layer i, which are stored twice.
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
ALIAS = re.compile(r"(encoder\.)modulations\.(\d+)\.")


def our_key(published: str) -> str | None:
    """Our name of a published parameter, ``system.`` already taken off; None where the table has no row for it."""
    for theirs, ours in KEY_MAP:
        if published.startswith(theirs):
            return ALIAS.sub(
                lambda m: f"{m[1]}model.encoder.layer.{int(m[2]) // 2}.norm{1 + int(m[2]) % 2}_modulation.",
                ours + published[len(theirs) :],
            )
    return None
