"""Parameters for training from scratch."""

import math

from torch import nn

from reli3d.nn.heads import Heads, WeightMerger
from reli3d.nn.reni import EnvironmentDecoder
from reli3d.nn.tokenizers import ImageTokenizer, Modulation, PixelShuffleUpsampler, TriplaneBank
from reli3d.nn.transformer import TwoStreamTransformer

STD = 0.02  # truncated normal of transformer weights
START_DENSITY_OFFSET = 2.0  # raw density below the surface's at the start: every point outside, probability about 0.12


def initialize(model: nn.Module) -> None:
    """Fill the parameters of a :class:`reli3d.nn.model.Reconstructor` in place, from torch's global generator.

    Linear weights are truncated normal; modulations start as the identity; the density starts outside.
    """
    for module in model.modules():
        if isinstance(module, nn.Linear):
            nn.init.trunc_normal_(module.weight, std=STD)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
        elif isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            nn.init.zeros_(module.bias)
    for module in model.modules():
        if isinstance(module, Modulation):
            nn.init.zeros_(module.linear2.weight)
        elif isinstance(module, TriplaneBank):
            nn.init.normal_(module.embeddings, std=1.0 / math.sqrt(module.embeddings.shape[1]))
        elif isinstance(module, ImageTokenizer):
            nn.init.trunc_normal_(module.model.embeddings.cls_token, std=STD)
            nn.init.trunc_normal_(module.model.embeddings.position_embeddings, std=STD)
            nn.init.trunc_normal_(module.model.embeddings.patch_embeddings.projection.weight, std=STD)
            layers = module.model.encoder.layer
            _shrink([x for y in layers for x in (y.attention.output.dense, y.mlp.fc2)])
        elif isinstance(module, TwoStreamTransformer):
            nn.init.trunc_normal_(module.latent_init, std=STD)
        elif isinstance(module, Heads):
            for name, layers in module.items():
                for layer in layers:
                    if isinstance(layer, nn.Linear):
                        nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
                        bound = 1.0 / math.sqrt(layer.in_features)
                        nn.init.uniform_(layer.bias, -bound, bound)
                if name in ("normal", "deformation"):
                    _normal(layers, 0.01)
            nn.init.constant_(module["density"][-1].bias, model.surface_density - START_DENSITY_OFFSET)
        elif isinstance(module, WeightMerger):
            _normal(module.mlp, 0.05)
        elif isinstance(module, PixelShuffleUpsampler):
            nn.init.normal_(module.upsample[-2].weight, std=1.0 / math.sqrt(module.upsample[-2].weight[0].numel()))
        elif isinstance(module, EnvironmentDecoder):  # its inputs are of order one and it has norms of its own
            for part in module.modules():
                if isinstance(part, nn.Linear):
                    part.reset_parameters()
    for stream in (model.backbone, model.illumination.transformer):
        _shrink(
            [m.proj for m in stream.modules() if hasattr(m, "wq")]
            + [m.to_out[0] for m in stream.modules() if hasattr(m, "to_q")]
            + [m.net[2] for m in stream.modules() if hasattr(m, "net")]
        )
    tokens = model.illumination.bank.embeddings
    nn.init.normal_(tokens, std=1.0 / math.sqrt(tokens.shape[1]))


def _shrink(outputs: list[nn.Linear]) -> None:
    for layer in outputs:
        nn.init.trunc_normal_(layer.weight, std=STD / math.sqrt(len(outputs)))


def _normal(layers: nn.Sequential, std: float) -> None:
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.normal_(layer.weight, std=std)
            nn.init.zeros_(layer.bias)
