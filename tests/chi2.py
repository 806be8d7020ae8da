"""Chi-square test of samples on the sphere against a density [1/sr]."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.special import gammaincc
from torch import Tensor

EXPECTED_MIN = 5.0  # below this count the normal limit behind chi-square fails (Cochran 1954)
IRES = 8  # midpoints a side of a window's cell


def p_value(directions: Tensor, pdf: Callable[[Tensor], Tensor], *, total: int | None = None, res: int = 51, ires: int
= 4,
            up: int = 2) -> float:  # fmt: skip
    """Probability of counts as uneven as those of unit ``directions (N, 3)`` under ``pdf``; 0 for impossible ones.

    Cells are (phi, cos theta) about axis ``up``, ``2 res`` by ``res`` (odd, so that the equator is on no border),
    their mass the mean of ``pdf`` on ``ires`` x ``ires`` midpoints.  ``total`` counts samples drawn; those not in
    ``directions`` are invalid and must make up the mass that ``pdf`` lacks.
    """
    total = len(directions) if total is None else total
    d = directions.detach().cpu().double().numpy()
    a, b = d[:, (up + 1) % 3], d[:, (up + 2) % 3]
    x = np.clip((np.arctan2(b, a) / (2 * np.pi) % 1.0 * 2 * res).astype(int), 0, 2 * res - 1)
    y = np.clip(((d[:, up] * 0.5 + 0.5) * res).astype(int), 0, res - 1)
    observed = np.bincount(y * 2 * res + x, minlength=2 * res * res).astype(float)
    return pooled_p_value(d, observed, cell_masses(pdf, res, ires, up, directions.device) * total, total)


def pooled_p_value(d: np.ndarray, observed: np.ndarray, expected: np.ndarray, total: int) -> float:
    """Probability of counts ``observed`` of ``d`` where ``expected`` are due; of ``total`` the rest is one cell."""
    if abs(np.linalg.norm(d, axis=1) - 1.0).max(initial=0.0) > 1e-5:
        return 0.0
    if (
        observed[expected == 0.0].sum() > 1e-5 * total
    ):  # pbrt's allowance: a cell's corner may have density, no midpoint
        return 0.0
    if expected.sum() > 1.01 * total:
        return 0.0
    lacking, missing = total - expected.sum(), total - observed.sum()
    if lacking > EXPECTED_MIN or missing > 0:
        observed, expected = np.append(observed, missing), np.append(expected, max(lacking, 1e-9))
    order = np.argsort(expected)
    observed, expected = observed[order], expected[order]
    pool = np.floor(np.cumsum(expected) / EXPECTED_MIN).astype(int)
    first = int(np.searchsorted(expected, EXPECTED_MIN))  # cells from here stand alone
    label = np.where(np.arange(len(expected)) < first, np.minimum(pool, pool[first - 1] - 1 if first else 0), -1)
    label = np.maximum(label, 0)
    label[first:] = label[:first].max(initial=-1) + 1 + np.arange(len(expected) - first)
    o, e = np.bincount(label, observed), np.bincount(label, expected)
    o, e = o[e > 0], e[e > 0]
    if len(e) < 2:
        return 1.0 if abs(o.sum() - e.sum()) < 1e-3 * total else 0.0
    return float(gammaincc((len(e) - 1) / 2.0, (((o - e) ** 2) / e).sum() / 2.0))


def cell_masses(pdf: Callable[[Tensor], Tensor], res: int, ires: int, up: int = 2, device=None) -> np.ndarray:
    """Integral of ``pdf`` over each cell, ``(res * 2 res,)`` float64."""
    phi = (np.arange(2 * res * ires) + 0.5) / (2 * res * ires) * 2 * np.pi
    height = (np.arange(res * ires) + 0.5) / (res * ires) * 2 - 1
    value = np.empty((res, 2 * res))
    rows = max(1, (1 << 20) // (2 * res * ires * ires))  # of cells at once: 50 MB
    for first in range(0, res, rows):
        z, turn = np.meshgrid(height[first * ires : (first + rows) * ires], phi, indexing="ij")
        s = np.sqrt(1 - z * z)
        d = np.empty((*z.shape, 3), np.float32)
        d[..., up], d[..., (up + 1) % 3], d[..., (up + 2) % 3] = z, s * np.cos(turn), s * np.sin(turn)
        part = pdf(torch.from_numpy(d.reshape(-1, 3)).to(device)).detach().cpu().double().numpy()
        value[first : first + rows] = part.reshape(-1, ires, 2 * res, ires).mean((1, 3))
    return value.reshape(-1) * (4 * np.pi / (2 * res * res))


def window_p_value(
    directions: Tensor, pdf: Callable[[Tensor], Tensor], wo: Tensor, alpha: float, *, total: int, res: int = 64
) -> float:
    """:func:`p_value` in a window that resolves what GGX of width ``alpha`` reflects from a grazing ``wo (3,)``.

    Such a lobe is less than a degree high and narrower yet across, thinner than the cells of any affordable grid on the
    sphere, and the horizon cuts it.  Here the sphere is projected from its centre onto the plane that touches the
    horizon opposite ``wo``; cells are steps of the height ``v`` there and of ``s = u / (v + v_o)``, ``v_o`` the height
    of ``wo``: nearly the half vector's slope across, so the lobe is as wide at every height.  The horizon is the
    window's border; what lies outside or is invalid is one cell.
    """
    x, y, z = wo.double().tolist()
    flat = (x * x + y * y) ** 0.5
    level, across = np.array([-x, -y, 0.0]) / flat, np.array([y, -x, 0.0]) / flat
    wide, high = 6.0 * alpha, np.tan(12.0 * alpha + np.arctan(z / flat))  # in slopes of the half vector 6 alpha
    d = directions.detach().cpu().double().numpy()
    with np.errstate(divide="ignore", invalid="ignore"):
        v = d[:, 2] / (d @ level)
        s = d @ across / (d @ level) / (v + z / flat)
    inside = (d @ level > 0.0) & (v >= 0.0) & (v < high) & (abs(s) < wide)
    column = ((s[inside] / wide * 0.5 + 0.5) * res).astype(int)
    observed = np.bincount((v[inside] / high * res).astype(int) * res + column, minlength=res * res).astype(float)
    middle = (np.arange(res * IRES) + 0.5) / (res * IRES)
    v, s = np.meshgrid(middle * high, (middle * 2 - 1) * wide, indexing="ij")
    u = s * (v + z / flat)
    at = level + u[..., None] * across + v[..., None] * np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(at, axis=-1)
    density = pdf(torch.from_numpy((at / length[..., None]).reshape(-1, 3)).float().to(directions.device))
    density = density.cpu().double().numpy().reshape(u.shape) * (v + z / flat) / length**3  # [1/sr] to [1 / (s v)]
    mass = density.reshape(res, IRES, res, IRES).mean((1, 3)).reshape(-1) * (high * 2.0 * wide / res**2)
    return pooled_p_value(d, observed, mass * total, total)


TESTS = 8 * 30 + 30  # of the suite: four samplers at two azimuths for each of 30 lobes, and the rest


def sidak(tests: int = TESTS, level: float = 0.01) -> float:
    """Level of one of ``tests`` independent tests for the family to have ``level``."""
    return 1.0 - (1.0 - level) ** (1.0 / tests)
