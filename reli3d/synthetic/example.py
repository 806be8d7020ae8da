"""The example object of the package: an enameled kettle with a wooden grip and brass fittings on a wooden board.

No family of ``procedural.py`` generates it, so it is not in the training set.
"""

from __future__ import annotations

import numpy as np

from reli3d.synthetic import patterns as pt
from reli3d.synthetic import primitives as p
from reli3d.synthetic.assembly import Assembly
from reli3d.synthetic.materials import Coat, Material

TEAL, CREAM, CHARCOAL = (0.02, 0.19, 0.22), (0.78, 0.7, 0.52), (0.03, 0.028, 0.026)
BRASS, STEEL = (0.86, 0.66, 0.3), (0.58, 0.58, 0.59)
OAK, DARK_OAK, WALNUT, DARK_WALNUT = (0.42, 0.26, 0.12), (0.22, 0.12, 0.05), (0.2, 0.085, 0.035), (0.08, 0.035, 0.018)


def kettle(a: Assembly) -> None:
    """Adds the solids; the parts are in the order of the materials of :func:`finish`."""
    body, lid, knob, arms, grip, spout, trim, board = (a.part("any") for _ in range(8))
    height = np.linspace(0, 0.62, 32)
    belly = p.curve([[0.44, 0], [0.5, 0.08], [0.47, 0.26], [0.37, 0.44], [0.27, 0.55], [0.235, 0.62]], 32)
    a.add(p.solid_of_profile(belly[:, 0], height, 72), body)
    line = p.curve([[0.38, 0.14, 0], [0.55, 0.22, 0], [0.66, 0.42, 0], [0.76, 0.54, 0]], 26)
    width = np.linspace(0.125, 0.052, 26)
    a.add(p.tube(line, width, segments=28), spout)
    a.add(p.tube(line[-4:], width[-4:] + 0.012, segments=28), trim)
    a.cut(p.tube(line[14:] + 0.02 * (line[-1] - line[-2]), width[14:] - 0.014, segments=24), spout)
    axis = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    a.cut(p.capsule(line[-1] - 0.05 * axis, line[-1] + 0.1 * axis, 0.036), spout)
    a.add(p.torus(0.245, 0.017, segments=72), trim, (0, 0.62, 0))
    a.add(p.torus(0.452, 0.014, segments=72), trim, (0, 0.02, 0))
    dome = np.linspace(0, np.pi / 2, 14)
    a.add(p.solid_of_profile(0.225 * np.cos(dome), 0.62 + 0.085 * np.sin(dome), 64), lid)
    neck = [0.035, 0.69], [0.022, 0.73], [0.03, 0.75], [0.058, 0.785], [0.056, 0.82], [0.03, 0.845], [0.004, 0.85]
    fine = p.curve(neck, 24)
    a.add(p.solid_of_profile(fine[:, 0].clip(0.003), fine[:, 1], 40), knob)
    rise = np.array([[0.3, 0.52, 0], [0.345, 0.72, 0], [0.2, 0.98, 0]])
    arch = p.curve([*rise * (-1, 1, 1), (0, 1.04, 0), *rise[::-1]], 60)
    a.add(p.tube(arch, 0.021, segments=16), arms)
    swell = 0.04 + 0.016 * np.sin(np.linspace(0, np.pi, 24))
    a.add(p.tube(arch[18:42], swell, segments=24), grip)
    for side in (-1, 1):
        a.add(p.ellipsoid((0.05, 0.06, 0.05), 32), arms, (side * 0.3, 0.53, 0))
        a.add(p.cylinder(0.022, 0.14, bevel=0.006, segments=24).rotate((90, 0, 0)), trim, (side * 0.3, 0.53, 0))
    a.add(p.box((1.2, 0.06, 1.0), 0.02), board, (0.06, -0.03, 0))
    for x in (-0.46, 0.58):
        a.add(p.box((0.09, 0.06, 0.86), 0.015), board, (x, -0.08, 0))


def finish() -> tuple[Material, ...]:
    """Materials of the parts: body, lid, knob, arms, grip, spout, trim, board."""
    horizontal = np.diag([1.0, 1.0, 1.0])[[1, 0, 2]]
    enamel, cream = Coat(TEAL, 0.2), Coat(CREAM, 0.24)
    chips = pt.Blotches(5.0 * np.eye(3), 11, 0.95, 0.04, octaves=5, gain=0.6)
    body = Material(
        enamel,
        (
            (cream, pt.Ramp((0.0, 1.0, 0.0), -0.012, -0.008, 0.0, 0)),
            (enamel, pt.Bands(9.5 * horizontal, 0.16, 0.38, softness=0.02)),
            (Coat((0.55, 0.06, 0.03), 0.25), pt.Dots(11.0 * np.eye(3), 0.22)),
            (enamel, pt.Ramp((0.0, -1.0, 0.0), 0.03, 0.034, 0.0, 0)),
            (Coat(CHARCOAL, 0.75), chips),
        ),
        drift=0.03,
        drift_roughness=0.03,
        drift_scale=4.0,
        seed=5,
    )
    plain = Material(enamel, ((Coat(CHARCOAL, 0.75), chips),), drift=0.03, drift_roughness=0.03, seed=6)
    fiber = np.diag([0.8, 60.0, 60.0])
    steel = Material(
        Coat(STEEL, 0.32, 1.0),
        ((Coat((0.2, 0.08, 0.035), 0.9, 0.0), pt.Blotches(9.0 * np.eye(3), 3, 0.75, 0.15, octaves=5, gain=0.6)),),
        (pt.Emboss(fiber, 2, 0.0006, octaves=1),),
        drift_roughness=0.05,
        seed=7,
    )
    brass = Material(
        Coat(BRASS, 0.22, 1.0),
        ((Coat((0.3, 0.2, 0.09), 0.5, 1.0), pt.Blotches(4.0 * np.eye(3), 9, 0.1, 0.6, octaves=4)),),
        drift_roughness=0.06,
        seed=8,
    )

    def wood(light, dark, rough: float, seed: int) -> Material:
        axes = np.eye(3)[[1, 2, 0]]  # the fibers run along x
        grain = pt.Grain(2.6 * axes, seed, 5.0, (1.7, 0.9))
        bump = pt.Emboss(np.diag([30.0, 30.0, 1.2]) @ axes, seed + 1, 0.003, octaves=1)
        return Material(
            Coat(light, rough), ((Coat(dark, min(rough + 0.1, 1.0)), grain),), (bump,), drift=0.1, seed=seed
        )

    return body, plain, brass, steel, wood(WALNUT, DARK_WALNUT, 0.38, 21), plain, brass, wood(OAK, DARK_OAK, 0.6, 31)
