"""Chi-square test of samples on the sphere against a density [1/sr]; each use shows on the spot that it could fail."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import gammaincc, ndtri
from torch import Tensor

Density = Callable[[Tensor], Tensor]

ALPHAS, DEGREES, AZIMUTHS = (0.02, 0.05, 0.1, 0.25, 0.5, 1.0), (0, 15, 45, 80, 89), (0.4, 3.9)
DRAWS = ("half vector", "visible", "opposite", "mirrored")
LOBES = [(alpha, deg, phi) for alpha in ALPHAS for deg in DEGREES for phi in (AZIMUTHS if deg else AZIMUTHS[:1])]
MIXTURES = [(0.1, 45), (0.5, 80), (1.0, 0)]
MAPS = ("one texel", "constant", "3 x 2", "sun", "next to the sun", "four black rows", "one black row", "odd")
# of the suite: fraction, fine and coarse pass of each case and one for the cosine, on both devices
TESTS = 2 * 3 * (len(LOBES) * len(DRAWS) + 2 * len(MIXTURES) + len(MAPS) + 1)
SIGNIFICANCE = 1.0 - 0.99 ** (1.0 / TESTS)  # Sidak: 1 % for the family
MAX_Z = float(-ndtri(SIGNIFICANCE / 2))  # standard deviations

EXPECTED_MIN = 5.0  # below this count the normal limit behind chi-square fails (Cochran 1954)
CELLS_MIN = 90  # of the fine pass
QUADRATURE = 1e-3  # of a mass


@dataclass(frozen=True)
class Sphere:
    """Cells in (cos theta, phi) about the axis x, ``res`` by ``2 res``: no lobe is in the fan around the pole, and
    the horizon z = 0 is a border."""

    res: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.res, 2 * self.res

    def places(self, d: Tensor) -> tuple[Tensor, Tensor]:
        """How far along the rows' axis and the columns' directions ``(N, 3)`` lie, in [0, 1] where they are inside."""
        turn = torch.atan2(d[:, 2], d[:, 1]) / (2 * math.pi)
        return d[:, 0] * 0.5 + 0.5, torch.where(turn < 0.0, turn + 1.0, turn)

    def at(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Directions of places, and the solid angle [sr] of the unit square as seen from there."""
        z, turn = 2.0 * y - 1.0, 2 * math.pi * x
        s = (1.0 - z * z).sqrt()
        d = torch.stack([z.float(), (s * turn.cos()).float(), (s * turn.sin()).float()], -1)
        return d, torch.full_like(z, 4 * math.pi)


@dataclass(frozen=True)
class Map:
    """Texels of a lat-long map, each cut into ``side`` by ``side``."""

    height: int
    width: int
    side: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.height * self.side, self.width * self.side

    def places(self, d: Tensor) -> tuple[Tensor, Tensor]:
        x, y, z = d.double().unbind(-1)
        return torch.atan2(torch.hypot(x, z), y) / math.pi, torch.atan2(z, x) / (2 * math.pi) + 0.5

    def at(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        theta, turn = math.pi * y, 2 * math.pi * x
        s = theta.sin()
        return torch.stack([-turn.cos() * s, theta.cos(), -turn.sin() * s], -1), s * (2 * math.pi**2)


@dataclass(frozen=True)
class Window:
    """Cells that resolve what GGX of width ``alpha`` reflects from a grazing ``wo (3,)``.

    Such a lobe is less than a degree high and narrower yet across, thinner than the cells of any affordable grid on the
    sphere, and the horizon cuts it.  Here the sphere is projected from its center onto the plane that touches the
    horizon opposite ``wo``; cells are steps of the height ``v`` there and of ``s = u / (v + v_o)``, ``v_o`` the height
    of ``wo``: nearly the half vector's slope across, so the lobe is as wide at every height.  The horizon is the
    window's border.
    """

    wo: Tensor
    alpha: float
    mirrored: bool = False
    shape: tuple[int, int] = (64, 64)

    def frame(self) -> tuple[Tensor, Tensor, float, float, float]:
        x, y, z = self.wo.double().tolist()
        flat = math.hypot(x, y)
        axes = torch.tensor([[-x, -y, 0.0], [y, -x, 0.0]], dtype=torch.float64, device=self.wo.device) / flat
        high = 3.1 * z / flat  # a mirrored normal faces wo, so wi is at most 3 times as high
        if not self.mirrored:
            high = math.tan(12.0 * self.alpha + math.atan(z / flat))  # a slope of 6 alpha of the half vector
        return *axes, z / flat, high, 6.0 * self.alpha

    def places(self, d: Tensor) -> tuple[Tensor, Tensor]:
        horizontal, across, own, high, wide = self.frame()
        ahead = d.double() @ horizontal
        v = torch.where(ahead > 0.0, d[:, 2] / ahead, -1.0)
        return v / high, (d.double() @ across) / ahead / (v + own) / wide * 0.5 + 0.5

    def at(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        horizontal, across, own, high, wide = self.frame()
        v, s = y * high, (2.0 * x - 1.0) * wide
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device=horizontal.device)
        d = horizontal + (s * (v + own))[:, None] * across + v[:, None] * up
        length = d.norm(dim=-1)
        return d / length[:, None], (v + own) / length**3 * (2.0 * wide * high)


Grid = Sphere | Map | Window


def counts(grid: Grid, down: Tensor, across: Tensor) -> np.ndarray:
    """Samples in each cell; those outside are in none."""
    rows, columns = grid.shape
    inside = (down >= 0.0) & (down <= 1.0) & (across >= 0.0) & (across <= 1.0)
    cell = (down * rows).int().clamp(max=rows - 1) * columns + (across * columns).int().clamp(max=columns - 1)
    count = torch.bincount(torch.where(inside, cell, rows * columns), minlength=rows * columns + 1)
    return count[:-1].reshape(rows, columns).cpu().double().numpy()


def masses(grid: Grid, pdf: Density, device: torch.device, finest: int = 64) -> np.ndarray:
    """Integral of ``pdf`` over each cell: midpoints, twice as many a side (``finest`` at most) while they move it."""
    side = 2
    mass = _midpoints(grid, pdf, torch.ones(grid.shape, dtype=torch.bool, device=device), side).reshape(grid.shape)
    least = 1e-7 * mass.sum()  # a tenth of a sample in a million
    moved = mass > least
    while side < finest and moved.any():
        side *= 2
        near = torch.nn.functional.max_pool2d(moved[None].float(), 3, 1, 1)[0] > 0.0  # an edge may miss all midpoints
        finer = _midpoints(grid, pdf, near, side)
        moved = torch.zeros_like(near)
        moved[near] = (finer - mass[near]).abs() > least
        mass[near] = finer
    return mass.cpu().numpy()


def _midpoints(grid: Grid, pdf: Density, where: Tensor, side: int) -> Tensor:
    rows, columns = grid.shape
    step = (torch.arange(side, dtype=torch.float64, device=where.device) + 0.5) / side
    out = []
    for part in where.reshape(-1).nonzero()[:, 0].split(max(1, (1 << 18) // side**2)):
        y = ((part // columns)[:, None, None] + step[:, None]) / rows
        x = ((part % columns)[:, None, None] + step) / columns
        y, x = (v.reshape(-1) for v in torch.broadcast_tensors(y, x))
        d, angle = grid.at(y, x)
        density = pdf(d.float()).detach().double()
        assert bool((density >= 0.0).all()), "a density is negative or not a number"
        out.append((density * angle).reshape(len(part), -1).mean(1) / (rows * columns))
    return torch.cat(out)


def pooled(observed: np.ndarray, expected: np.ndarray) -> tuple[float, int]:
    """Probability of counts as uneven as these where ``expected`` are due (both of one sum), and the number of cells:
    those of less than :data:`EXPECTED_MIN` are put together, the smallest first.  A single cell decides nothing: 0."""
    order = np.argsort(expected, axis=None)
    o, e = observed.ravel()[order], expected.ravel()[order]
    small = int(np.searchsorted(e, EXPECTED_MIN))
    label = np.arange(len(e)) + len(e)
    label[:small] = np.cumsum(e[:small]) // (2 * EXPECTED_MIN)  # each holds at least half of that, but for the last
    last = label[:small] == label[small - 1] if small else np.zeros(0, bool)
    if e[:small][last].sum() < EXPECTED_MIN:  # ... which goes to the next cell
        label[:small][last] = len(e) + small if small < len(e) else label[small - 1] - 1
    _, label = np.unique(label, return_inverse=True)
    o, e = np.bincount(label, o), np.bincount(label, e)
    return (float(gammaincc((len(e) - 1) / 2.0, (((o - e) ** 2) / e).sum() / 2.0)) if len(e) > 1 else 0.0), len(e)


def quantiles(mass: np.ndarray, q: int) -> np.ndarray:
    """Labels of ``q`` by ``q`` connected groups of cells with about equal mass: strips of rows, cut into columns."""
    strip = np.minimum(_below(mass.sum(1)) * q, q - 1).astype(int)
    per = np.zeros((q, mass.shape[1]))
    np.add.at(per, strip, mass)
    return strip[:, None] * q + np.minimum(_below(per) * q, q - 1).astype(int)[strip]


def _below(mass: np.ndarray) -> np.ndarray:
    """Fraction of ``mass`` before the middle of each cell along the last axis."""
    return (np.cumsum(mass, -1) - 0.5 * mass) / np.maximum(mass.sum(-1, keepdims=True), 1e-300)


def lost(valid: float, mass: float, total: int) -> str:
    """Why ``valid`` of ``total`` draws are not the fraction ``mass`` of a density; empty where they may be."""
    noise = (max(mass * (1.0 - mass), 0.0) / total) ** 0.5
    if abs(valid / total - mass) <= QUADRATURE * mass + MAX_Z * noise:
        return ""
    return f"fraction of valid samples {valid / total:.6f}, mass {mass:.6f}"


def refusal(observed: np.ndarray, mass: np.ndarray, total: int) -> str:
    """Why counts of ``total`` draws are not of a density with these masses; empty where they may be.

    The fraction of counted draws must be the mass; given that, chi-square holds the shape, once on all cells
    and once on few: an error of 2 % has noncentrality 4e-4 n, which many cells' own noise sqrt(2 cells) drowns.
    """
    valid = observed.sum()
    why = lost(valid, mass.sum(), total)
    if why:
        return why
    if observed[mass == 0.0].sum() > 1e-5 * valid:  # pbrt's allowance for borders
        return "samples where the density is 0"
    expected = mass * (valid / mass.sum())
    p, cells = pooled(observed, expected)
    if cells < CELLS_MIN or p < SIGNIFICANCE:
        return f"{cells} cells, p = {p:.2g}"
    label = quantiles(mass, max(3, int(valid**0.5 / 80))).ravel()  # 2 % is 7 times the noise at 1e5 samples, 22 at 1e6
    p, cells = pooled(np.bincount(label, observed.ravel()), np.bincount(label, expected.ravel()))
    return f"{cells} coarse cells, p = {p:.2g}" if p < SIGNIFICANCE else ""


def check(
    grid: Grid,
    drawn: Tensor,
    pdf: Density,
    wrong: dict[str, Density] | None = None,
    total: int | None = None,
    finest: int = 64,
) -> None:
    """Assert that unit ``drawn (N, 3)``, the valid ones of ``total`` draws, follow ``pdf``, and that on this grid and
    with these samples densities that are wrong by 2 to 3 % and those named in ``wrong`` are refused."""
    total = len(drawn) if total is None else total
    assert float((drawn.norm(dim=-1) - 1.0).abs().max()) < 1e-5
    down, across = grid.places(drawn)
    observed, mass = counts(grid, down, across), masses(grid, pdf, drawn.device, finest)
    why = refusal(observed, mass, total)
    assert not why, why
    planted = {f"scale {s}": mass * s for s in (0.98, 1.02)}
    ramps = {"rows": 2.0 * _below(mass.sum(1))[:, None] - 1.0, "columns": 2.0 * _below(mass.sum(0)) - 1.0}
    for name, ramp in ramps.items():  # from -1 to 1 over the mass, 1 / sqrt(3) in the root mean square
        planted |= {f"tilt {t} along {name}": mass * (1.0 + t * 3.0**0.5 * ramp) for t in (-0.03, 0.03)}
    planted |= {name: masses(grid, other, drawn.device, finest) for name, other in (wrong or {}).items()}
    for name, other in planted.items():
        assert refusal(observed, other, total), f"planted error passes: {name}"
    assert refusal(counts(grid, across, down), mass, total), "planted error passes: axes swapped"
