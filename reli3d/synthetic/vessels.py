"""Families of vessels, lamps and containers.  ``manmade.py`` defines a family."""

import itertools

import numpy as np

from reli3d.synthetic import primitives as p
from reli3d.synthetic.assembly import Assembly


def vessel(a: Assembly) -> None:
    """Body of revolution: bottle, vase, bowl, goblet, mug, jug, pot with lid, lamp, candlestick, chess piece."""
    rng, u = a.rng, a.rng.uniform
    height, count = u(0.4, 2.6) if rng.random() < 0.8 else u(0.15, 0.4), int(rng.integers(4, 8))
    knots = np.linspace(0, height, count)
    radius = 0.5 * np.exp(rng.normal(0, 0.45, count)).clip(0.25, 1.9)
    radius[0] = max(radius[0], 0.3 * radius.max())  # it must stand
    if rng.random() < 0.35:  # shoulders of a bottle
        radius[-2:] = radius[0] * u(0.2, 0.5)
        radius[: count - 2] = radius[0] * u(0.9, 1.1)
    fine = p.curve(np.stack([radius, knots], -1), 28) if rng.random() < 0.75 else np.stack([radius, knots], -1)
    fine[:, 0] = fine[:, 0].clip(0.06)
    fine[:, 1] = np.maximum.accumulate(fine[:, 1].clip(0, height) + np.arange(len(fine)) * 1e-6)
    segments = int(rng.choice([6, 8, 12, 32, 40, 48], p=[0.04, 0.05, 0.04, 0.27, 0.3, 0.3]))
    body = a.random_part("ceramic", "metal", "plastic", "wood", "paint", "stone", p=[0.4, 0.15, 0.15, 0.1, 0.1, 0.1])
    a.add(p.solid_of_profile(fine[:, 0], fine[:, 1], segments), body)
    wide = fine[:, 0].max()
    if rng.random() < 0.3:
        where = fine[int(rng.integers(1, len(fine) - 1))]
        band = a.random_part("accent", "metal")
        a.add(p.torus(where[0], wide * u(0.02, 0.06), segments=segments), band, (0, where[1], 0))
    hollow = rng.random() < 0.6
    if hollow:
        wall = wide * u(0.03, 0.1)
        inside = fine[fine[:, 1] > wall * 1.2]
        if len(inside) > 2 and inside[-1, 0] > 1.6 * wall:
            inner = np.maximum(inside[:, 0] - wall, 0.3 * wall)
            top = np.append(inner, inner[-1]), np.append(inside[:, 1], height + 1.0)
            a.cut(p.solid_of_profile(*top, segments), a.part("accent") if rng.random() < 0.3 else body)
    else:
        _lid(a, fine[-1, 0], height, segments)
    if rng.random() < 0.4:
        handles = 1 if rng.random() < 0.6 else 2
        low, high = sorted(u(0.15, 0.9, 2) * height)
        high = max(high, low + 0.25 * height)
        at = lambda y: float(np.interp(y, fine[:, 1], fine[:, 0]))
        out = wide + u(0.12, 0.5)
        reach = [at(low) * 0.96, (out + at(low)) / 2, out, (out + at(high)) / 2, at(high) * 0.96]
        path = p.curve(np.stack([reach, [low, low - 0.02, (low + high) / 2, high + 0.03, high]], -1), 20)
        thick = u(0.03, 0.075) * max(wide, 0.5)
        grip = p.tube(np.concatenate([path, np.zeros((20, 1))], 1), thick, segments=10).scale((1, 1, u(0.8, 1.8)))
        handle = body if rng.random() < 0.6 else a.random_part("wood", "metal", "plastic")
        keep = grip - p.solid_of_profile(fine[:, 0] * 0.93, fine[:, 1], 32)
        a.copy_turned(keep, handle, handles)
        if handles == 1 and rng.random() < 0.5:  # a spout on the other side
            y = u(0.3, 0.6) * height
            tip = -(wide + u(0.2, 0.5)), height * u(0.85, 1.05)
            line = p.curve([[-at(y) * 0.85, y, 0], [-(at(y) + wide) * 0.62, y + 0.1 * height, 0], [*tip, 0]], 14)
            a.add(p.tube(line, np.linspace(0.2, 0.07, 14) * wide), body)
    if rng.random() < 0.2:
        foot = a.random_part("wood", "metal", "stone")
        a.add(p.cylinder(fine[0, 0] * u(1.05, 1.5), u(0.04, 0.15), bevel=0.02, segments=segments), foot)


def _lid(a: Assembly, radius: float, height: float, segments: int) -> None:
    rng, u = a.rng, a.rng.uniform
    if rng.random() < 0.3:
        return
    lid = a.random_part("accent", "metal", "wood", "plastic")
    if rng.random() < 0.6:  # screw cap or cork
        tall = radius * u(0.4, 1.4)
        cap = p.cylinder(radius * u(0.9, 1.15), tall, bevel=0.04 * radius, segments=segments)
        a.add(cap, lid, (0, height + 0.45 * tall, 0))
    else:
        a.add(p.ellipsoid((radius * 1.03, radius * u(0.2, 0.5), radius * 1.03)), lid, (0, height, 0))
        a.add(p.ellipsoid(np.full(3, radius * u(0.12, 0.25))), lid, (0, height + radius * 0.5, 0))


def lamp(a: Assembly) -> None:
    """Table lamp, lantern or candlestick: foot, stem, shade, or a cage with a carrying ring."""
    rng, u = a.rng, a.rng.uniform
    frame = a.part("metal" if rng.random() < 0.6 else "paint")
    if rng.random() < 0.5:
        shade = a.random_part("fabric", "paint", "ceramic")
        tall, foot = u(0.6, 1.2), u(0.2, 0.4)
        stem = np.append(foot * np.exp(rng.normal(-0.8, 0.5, 4)).clip(0.1, 0.9), 0.04)
        knots = p.curve(np.stack([stem, np.linspace(0, tall, 5)], -1), 24)
        a.add(p.cylinder(foot, u(0.03, 0.1), bevel=0.015), frame)
        part = a.part("ceramic") if rng.random() < 0.5 else frame
        a.add(p.solid_of_profile(knots[:, 0].clip(0.025), knots[:, 1]), part)
        wide, top, high = u(0.35, 0.6), u(0.15, 0.45), u(0.3, 0.6)
        ring = np.array([[wide, 0], [top, high], [top - 0.02, high], [wide - 0.02, 0]])
        a.add(p.lathe(ring, int(rng.choice([8, 40]))), shade, (0, tall - 0.25 * high, 0))
        a.add(p.box((2 * top, 0.03, 0.03)), frame, (0, tall + 0.72 * high, 0))
        a.add(p.cylinder(0.02, high), frame, (0, tall + 0.25 * high, 0))
        return
    sides, radius, tall = int(rng.choice([4, 6, 8, 32])), u(0.25, 0.4), u(0.5, 0.9)
    a.add(p.cylinder(radius * 1.15, 0.09, bevel=0.02, segments=sides), frame, (0, 0, 0))
    a.add(p.cylinder(radius * 1.1, 0.07, bevel=0.02, segments=sides), frame, (0, tall, 0))
    a.add(p.cylinder(radius * 1.0, u(0.1, 0.3), top=radius * u(0.2, 0.5), segments=sides), frame, (0, tall + 0.12, 0))
    posts = max(sides, 4) if sides < 32 else int(rng.integers(4, 9))
    a.copy_turned(p.cylinder(0.022, tall, segments=8).translate((radius, tall / 2, 0)), frame, posts)
    glass = a.random_part("ceramic", "accent", "paint")
    pane = p.cylinder(radius * u(0.55, 0.9), tall, segments=32 if rng.random() < 0.5 else sides)
    a.add(pane, glass, (0, tall / 2, 0))
    if rng.random() < 0.8:
        ring = p.torus(0.14, 0.018, segments=24).rotate((90, 0, 0))
        a.add(ring, frame, (0, tall + 0.32, 0))
        a.add(p.cylinder(0.04, 0.3), frame, (0, tall + 0.1, 0))


def container(a: Assembly) -> None:
    """Crate, chest, barrel, basket, bucket, suitcase or box with frames, hoops and handles."""
    rng, u = a.rng, a.rng.uniform
    body = a.random_part("wood", "paint", "plastic", "metal", p=[0.4, 0.25, 0.2, 0.15])
    frame = a.random_part("metal", "wood", "accent")
    kind = rng.random()
    if kind < 0.35:  # barrel, drum, tin
        tall, bulge = u(0.8, 1.8), u(-0.02, 0.18)
        y = np.linspace(0, tall, 17)
        radius = 0.5 * (1 + bulge * (1 - (2 * y / tall - 1) ** 2))
        a.add(p.solid_of_profile(radius, y, 40), body)
        for at in np.linspace(0.02, 0.98, int(rng.integers(2, 6))) if rng.random() < 0.8 else []:
            wide = float(np.interp(at * tall, y, radius))
            a.add(p.cylinder(wide + 0.02, u(0.04, 0.1), bevel=0.015, segments=40), frame, (0, at * tall, 0))
        if rng.random() < 0.5:
            a.cut(p.cylinder(0.46, 0.1), body, (0, tall, 0))
        if rng.random() < 0.25:  # open
            a.cut(p.cylinder(0.43, tall * 1.6, segments=40), body, (0, tall, 0))
        return
    w, h, d = u(0.6, 1.3), u(0.4, 1.1), u(0.4, 1.0)
    a.add(p.box((w, h, d), float(rng.choice([0.0, 0.02, 0.06, 0.15]))), body)
    if kind < 0.7:  # frame of planks along the edges
        t = u(0.05, 0.12)
        for axis, s, r in itertools.product(range(3), (-1, 1), (-1, 1)):
            size = np.full(3, t)
            size[axis] = (w, h, d)[axis] + t * 0.6
            a.add(p.box(size, 0.1 * t), frame, np.roll([0, s, r], axis) * (w, h, d) / 2)
        if rng.random() < 0.4:
            brace = p.box((np.hypot(w, h) * 0.92, t, d + t * 0.7)).rotate((0, 0, np.degrees(np.arctan2(h, w))))
            a.add(brace, frame)
    elif kind < 0.85:  # chest: half-round lid, straps, lock
        lid = p.cylinder(0.5, w * 1.02, segments=40).rotate((0, 0, 90)).scale((1, 0.8, d))
        a.add(lid, body, (0, h / 2, 0))
        for x in (-0.33, 0.33):
            strap = p.cylinder(0.52, w * u(0.06, 0.1), segments=40).rotate((0, 0, 90)).scale((1, 0.8, d * 1.01))
            a.add(strap, frame, (x * w, h / 2, 0))
            a.add(p.box((w * 0.08, h, d * 1.04)), frame, (x * w, 0, 0))
        a.add(p.box((0.12, 0.16, 0.08), 0.02), frame, (0, 0.42 * h, d / 2))
    else:  # open box with handles
        t = u(0.03, 0.08)
        a.cut(p.box((w - 2 * t, h, d - 2 * t), 0.02), body, (0, 2 * t, 0))
        for s in (-1, 1):
            a.cut(p.box((4 * t, 0.12 * h, 0.35 * d), 0.05 * h), frame, (s * w / 2, 0.25 * h, 0))
    if rng.random() < 0.3:  # it must reach the walls of an open box
        span = w / 2 - 0.015 if kind >= 0.85 else 0.15
        arch = np.array([[-span, -0.02, 0], [-0.93 * span, 0.12, 0], [0.93 * span, 0.12, 0], [span, -0.02, 0]])
        a.add(p.tube(p.curve(arch, 16), 0.022, segments=10), frame, (0, h / 2, 0))
