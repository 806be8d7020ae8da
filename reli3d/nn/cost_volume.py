"""Depth of pixels by comparing the views at hypotheses along each pixel's ray, around the depth predicted per view.

Sources: Yao et al. 2018, MVSNet, arXiv 1804.02505 (cost volume); Guo et al. 2019, arXiv 1903.04025 (groups).
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.geometry.camera import Camera, image_plane
from reli3d.geometry.projection import gather_views
from reli3d.nn.pyramid import MIN_COVERAGE, depth_of_origin
from reli3d.nn.view_features import FAR_DISTANCE, NEAR_DISTANCE

STEPS = (0.006, 0.012, 0.024, 0.048, 0.096, 0.16)  # world units, about log-uniform as the errors have long tails
OFFSETS = (*(-s for s in reversed(STEPS)), 0.0, *STEPS)  # of the hypotheses from the predicted depth
PRIOR_DECAY = 0.06  # distance over which the initial probability of an offset falls by a factor of e
CHANNELS, GROUPS = 16, 4  # compared features of a pixel, and groups that each give one correlation
NEIGHBORS = 5  # views that a pixel is compared with, those of the closest directions
PAIR_WIDTH, POOLED_WIDTH, CONV_WIDTH = 16, 8, 8  # widths of the layers on pairs, of their mean, of the 3D convolutions
PAIR_FEATURES, OWN_FEATURES = 5, 5  # of a hypothesis in another view, and in its own
MIN_SPREAD = 1e-3  # standard deviation where one hypothesis is certain, so that its gradient is finite


class CostVolume(nn.Module):
    """Depth of the pixels of several views: the expectation over hypotheses compared between the views.

    At initialization offsets of either sign have equal scores, so that the predicted depth is returned.
    """

    def __init__(self, features: int):
        super().__init__()
        self.match = nn.Sequential(nn.Conv2d(features + 3, 32, 3, padding=1), nn.SiLU(), nn.Conv2d(32, CHANNELS, 1))
        self.pair = nn.Sequential(
            nn.Linear(GROUPS + PAIR_FEATURES, PAIR_WIDTH), nn.SiLU(), nn.Linear(PAIR_WIDTH, POOLED_WIDTH + 1)
        )
        last = nn.Conv3d(CONV_WIDTH, 1, 3, padding=1)
        nn.init.zeros_(last.weight)
        self.regular = nn.Sequential(
            nn.Conv3d(POOLED_WIDTH + OWN_FEATURES, CONV_WIDTH, 3, padding=1),
            nn.SiLU(),
            nn.Conv3d(CONV_WIDTH, CONV_WIDTH, 3, padding=1),
            nn.SiLU(),
            last,
        )
        self.prior = nn.Parameter(-torch.tensor(OFFSETS).abs() / PRIOR_DECAY)
        self.widening = nn.Parameter(torch.zeros(()))  # of the evidence of uncertain depths, see ahead_of_surface

    def forward(
        self,
        features: Tensor,
        color: Tensor,
        depth: Tensor,
        normal: Tensor,
        span: Tensor,
        camera: Camera,
        coverage: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Depth ``(V, Q, Q)`` relative to the world origin's, of ``V`` > 1 views, and its standard deviation.

        features: ``(V, Q, Q, F)``.  color: ``(V, Q, Q, 3)`` sRGB.  depth, normal: ``(V, Q, Q)`` and ``(V, Q, Q, 3)``,
        predicted per view; returned where nothing is covered, with 0.  span: ``(V, Q, Q, 2)`` from
        :func:`~reli3d.nn.pyramid.pixel_hull_depths`.  camera: of ``Q`` by ``Q`` pixels.  coverage: ``(V, Q, Q)``.
        Gradients reach all maps but ``span`` and every parameter but the last bias and ``widening``.
        """
        match = self.match(torch.cat([features, color], -1).permute(0, 3, 1, 2)).unflatten(1, (GROUPS, -1))
        match = functional.normalize(match, dim=2).flatten(1, 2).permute(0, 2, 3, 1)
        covered = (coverage > 0.5).to(depth)
        maps = torch.cat([match, torch.stack([depth * covered, covered], -1)], -1)
        toward = functional.normalize(camera.c2w[:, :3, 3], dim=-1)
        cosine = (toward @ toward.T * 1e4).round()  # so that ties do not depend on the device
        order = cosine.fill_diagonal_(-2e4).argsort(dim=1, descending=True, stable=True)
        shape = torch.cat([depth[..., None], span, normal], -1)
        valid = coverage > MIN_COVERAGE
        dense = [
            self._hypothesis_features(view, others, maps, shape[view], camera, valid[view])
            for view, others in enumerate(order[:, :-1][:, :NEIGHBORS].tolist())
        ]
        volume = torch.stack(dense).permute(0, 4, 3, 1, 2).contiguous(memory_format=torch.channels_last_3d)
        probability = (self.regular(volume)[:, 0].permute(0, 2, 3, 1) + self.prior).softmax(-1)
        offsets = probability.new_tensor(OFFSETS)
        mean = (probability * offsets).sum(-1)
        variance = (probability * (offsets - mean[..., None]).square()).sum(-1)
        return depth + mean * valid, (variance + MIN_SPREAD**2).sqrt() * valid

    def _hypothesis_features(
        self, view: int, others: list[int], maps: Tensor, shape: Tensor, camera: Camera, valid: Tensor
    ) -> Tensor:
        """Input of the 3D convolutions for one view, ``(Q, Q, K, C)``, zero except at the pixels ``valid``.

        maps: ``(V, Q, Q, CHANNELS + 2)``: features, depth times coverage, coverage.  shape: ``(Q, Q, 6)``: depth, span
        and normal.
        """
        pixels, c2w, origin = valid.nonzero(as_tuple=True), camera.c2w, depth_of_origin(camera.c2w)
        depth, near, far, normal = shape[pixels].split([1, 1, 1, 3], -1)
        offsets = depth.new_tensor(OFFSETS)
        at = depth + offsets
        right, up = (t[pixels] for t in image_plane(camera[view]))
        ray = torch.stack([right, up, -torch.ones_like(right)], -1) @ c2w[view, :3, :3].T
        point = c2w[view, :3, 3] + ray[:, None] * (at + origin[view])[..., None]
        got, place = gather_views(maps[others].contiguous(), point.reshape(-1, 3).contiguous(), camera[others])
        features, other, covered = got.unflatten(0, at.shape).split([CHANNELS, 1, 1], -1)
        correlation = (maps[view][pixels][:, None, None, :CHANNELS] * features).unflatten(-1, (GROUPS, -1)).sum(-1)
        shown = (covered > 0.5).to(depth)
        ahead = other / covered.clamp(min=0.1) - (place[..., 2:].unflatten(0, at.shape) - origin[others][:, None])
        toward = functional.normalize(c2w[others, :3, 3] - point[:, :, None], dim=-1)
        back = -functional.normalize(ray, dim=-1)
        facing, angle = ((toward * t[:, None, None]).sum(-1, keepdim=True) for t in (normal, back))
        ahead = [(ahead / NEAR_DISTANCE).tanh() * shown, (ahead / FAR_DISTANCE).tanh() * shown]
        layers, weight = self.pair(torch.cat([correlation, *ahead, shown, facing, angle], -1)).split(
            [POOLED_WIDTH, 1], -1
        )
        own = [
            ((at - near) / NEAR_DISTANCE).tanh(),
            ((far - at) / NEAR_DISTANCE).tanh(),
            (offsets / NEAR_DISTANCE).tanh().expand_as(at),
            (normal * back).sum(-1, keepdim=True).expand_as(at),
            torch.ones_like(at),
        ]
        found = torch.cat([(layers * weight.softmax(2)).sum(2), torch.stack(own, -1)], -1)
        return found.new_zeros(*valid.shape, *found.shape[1:]).index_put(pixels, found)
