"""Families of furniture and vehicles: tables, stools, chairs, benches, sofas, shelves, cabinets, toy cars.

Lengths are in meters, approximately; the floor is at y = 0 and the front faces +z.  ``manmade.py`` defines a family.
"""

import itertools

import numpy as np

from reli3d.synthetic import primitives as p
from reli3d.synthetic.assembly import Assembly


def _leg(a: Assembly, part: int, foot: np.ndarray, top: np.ndarray, thick: float, style: int) -> None:
    """Leg from ``foot`` to ``top``: square, round, tapered or turned."""
    rng = a.rng
    if style == 0:
        ring = thick * 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
        at = lambda q, s: np.stack([ring[:, 0] * s + q[0], np.full(4, q[1]), ring[:, 1] * s + q[2]], -1)
        a.add(p.Manifold.hull_points(np.concatenate([at(foot, 0.8), at(top, 1.0)])), part)
    elif style == 1:
        a.add(p.tube([foot, top], np.array([0.3, 0.5]) * thick, segments=16), part)
    else:
        t = np.linspace(0, 1, 20)[:, None]
        swell = 0.45 + 0.2 * np.sin(t[:, 0] * (10 if style == 2 else 4) + 1.0 + style) * np.sin(np.pi * t[:, 0])
        rng.random()  # not used, but later draws of a seed depend on it
        a.add(p.tube(foot + t * (top - foot), thick * swell, segments=14), part)


def _legs(a: Assembly, part: int, w: float, d: float, h: float, *, thick: float) -> None:
    """Four legs below a seat or a top of ``w`` by ``d`` at height ``h``, optionally splayed, with stretchers."""
    rng = a.rng
    style, splay = int(rng.choice(4, p=[0.5, 0.2, 0.2, 0.1])), rng.uniform(0, 0.18) * (rng.random() < 0.4)
    x, z = w / 2 - thick * 0.7, d / 2 - thick * 0.7
    for sx, sz in itertools.product((-1, 1), (-1, 1)):
        foot = np.array([sx * (x + splay * h), 0.0, sz * (z + splay * h)])
        _leg(a, part, foot, np.array([sx * x, h, sz * z]), thick, style)
    if rng.random() < 0.5:
        y, t = rng.uniform(0.15, 0.5) * h, thick * 0.55
        out = splay * (h - y)
        for s in (-1, 1):
            a.add(p.box((2 * (x + out), t * 1.3, t), 0.1 * t), part, (0, y, s * (z + out)))
            side = p.box((t, t * 1.3, 2 * (z + out)), 0.1 * t)
            a.add(side, part, (s * (x + out), y * rng.choice([1.0, 1.0, 1.25]), 0))


def table(a: Assembly) -> None:
    """Table, desk, bench or stool: rectangular or round top, four legs, a pedestal or panel sides, apron, drawers."""
    rng, u = a.rng, a.rng.uniform
    wood = a.part("wood" if rng.random() < 0.7 else "paint")
    top = wood if rng.random() < 0.6 else a.random_part("wood", "stone", "plastic", "leather", "fabric")
    h, w, d, t = u(0.4, 0.95), u(0.45, 1.7), u(0.4, 0.9), u(0.02, 0.07)
    if rng.random() < 0.35:  # stool
        w, d, t = u(0.28, 0.5), u(0.28, 0.5), u(0.02, 0.1)
    rounded = rng.random() < 0.3
    if rounded:
        d = w = min(w, 1.0)
        a.add(p.cylinder(w / 2, t, bevel=0.3 * t, segments=40), top, (0, h, 0))
        w = d = 0.7 * w
    else:
        a.add(p.box((w, t, d), u(0.02, 0.45) * t), top, (0, h, 0))
    thick, kind = u(0.03, 0.085), rng.random()
    if kind < 0.68:
        _legs(a, wood, w - 0.04, d - 0.04, h, thick=thick)
        if rng.random() < 0.6:
            y = u(0.05, 0.14)
            a.add(p.box((w - thick, y, d - thick)), wood, (0, h - y / 2, 0))
            a.cut(p.box((w - 2 * thick, 2 * y, d - 2 * thick)), wood, (0, h - y - t / 2 - 0.001, 0))
    elif kind < 0.85:
        radius = p.curve(np.stack([u(0.02, 0.07, 5), np.linspace(0, h, 5)], -1), 20)
        radius[:, 0] = radius[:, 0].clip(0.02)
        a.add(p.solid_of_profile(radius[:, 0], np.linspace(0, h, 20)), wood)
        if rng.random() < 0.5:
            a.add(p.cylinder(u(0.3, 0.5) * w, 0.04, bevel=0.015), wood, (0, 0.02, 0))
        else:
            foot = p.capsule((0, 0.12, 0), (u(0.35, 0.5) * w, 0.03, 0), 0.035, tip=0.025)
            a.copy_turned(foot, wood, int(rng.integers(3, 6)))
    else:
        for s in (-1, 1):
            a.add(p.box((t, h, d * 0.9)), wood, (s * (w / 2 - t), h / 2, 0))
        if rng.random() < 0.6:
            a.add(p.box((w - t, u(0.04, 0.3), t)), wood, (0, h * u(0.4, 0.8), -0.3 * d))
    if rng.random() < 0.2 and not rounded:
        _drawers(a, w * 0.35, 0.4 * h, d * 0.9, np.array([w * 0.28, h - 0.2 * h, 0]), wood)
    if rng.random() < 0.15:  # a vessel on top
        pot = p.cylinder(u(0.04, 0.09), u(0.08, 0.2), top=u(0.05, 0.12))
        a.add(pot, a.part("ceramic"), (u(-0.3, 0.3) * w, h + 0.06, u(-0.2, 0.2) * d))


def chair(a: Assembly) -> None:
    """Chair: legs, seat with or without cushion, back of posts with slats, bars or a panel, arms; or a shell."""
    rng, u = a.rng, a.rng.uniform
    wood = a.random_part("wood", "metal", "plastic", "paint", p=[0.55, 0.15, 0.15, 0.15])
    soft = a.random_part("fabric", "leather") if rng.random() < 0.5 else wood
    w, d, h, t = u(0.4, 0.6), u(0.38, 0.6), u(0.36, 0.5), u(0.02, 0.05)
    back, thick, lean = u(0.3, 0.65), u(0.025, 0.05), u(0.0, 0.16)
    _legs(a, wood, w, d, h, thick=thick)
    a.add(p.box((w, t, d), 0.4 * t), wood, (0, h, 0))
    if soft != wood:
        c = u(0.04, 0.11)
        a.add(p.box((w * 0.97, c, d * 0.97), c * 0.45), soft, (0, h + c / 2, 0.005))
    at = lambda s, y: np.array([s * (w / 2 - thick / 2), h + y, -d / 2 + thick / 2 - lean * y])
    for s in (-1, 1):
        _leg(a, wood, at(s, -0.02), at(s, back), thick, int(rng.integers(2)))
    style = rng.random()
    if style < 0.3:
        for y in np.linspace(0.25, 0.95, int(rng.integers(2, 5))) * back:
            a.add(p.box((w - thick, u(0.04, 0.1), 0.018), 0.006), wood, (at(0, y)))
    elif style < 0.55:
        a.add(p.box((w, 0.07, 0.03), 0.012), wood, at(0, back))
        for s in np.linspace(-0.75, 0.75, int(rng.integers(3, 8))):
            a.add(p.tube([at(s, 0), at(s, back)], 0.011, segments=8), wood)
    else:
        high, bevel = back * u(0.45, 0.8), u(0.01, 0.03)
        panel = p.box((w * 0.98, high, u(0.03, 0.09)), bevel).rotate((-np.degrees(np.arctan(lean)), 0, 0))
        a.add(panel, soft, at(0, back - high / 2 + 0.02))
    if rng.random() < 0.35:
        for s in (-1, 1):
            y, front = h + u(0.18, 0.24), d / 2 - 0.04
            a.add(p.tube(p.curve([at(s, y - h), (s * w / 2, y, front)], 4), 0.022, segments=8), wood)
            a.add(p.cylinder(0.018, y - h, segments=8), wood, (s * w / 2, (y + h) / 2, front))
    if rng.random() < 0.25:  # bent, as a molded shell
        k = u(0.2, 0.7)
        bend = lambda q: q[:, 2] + k * q[:, 0] ** 2 * (q[:, 1] > h) * np.sign(q[:, 2])
        a.warp(lambda q: np.column_stack([q[:, :2], bend(q)]), 0.08)


def sofa(a: Assembly) -> None:
    """Sofa, armchair or bed: rounded blocks, cushions and short feet."""
    rng, u = a.rng, a.rng.uniform
    soft = a.part("leather" if rng.random() < 0.4 else "fabric")
    feet = a.part("wood" if rng.random() < 0.6 else "metal")
    pillow = soft if rng.random() < 0.6 else a.part("fabric")
    w, d, h, seats = u(0.8, 2.2), u(0.7, 1.0), u(0.22, 0.36), int(rng.integers(1, 4))
    low, soften, arm, back = u(0.03, 0.18), u(0.02, 0.09), u(0.1, 0.26), u(0.35, 0.6)
    w = max(w, 0.5 * seats)
    a.add(p.box((w, h, d), soften * 0.7), soft, (0, low + h / 2, 0))
    if rng.random() < 0.85:
        rest = p.box((w, h + back, u(0.15, 0.28)), soften).rotate((-u(0, 8), 0, 0))
        a.add(rest, soft, (0, low + (h + back) / 2, -d / 2 + 0.05))
        if rng.random() < 0.4:
            roll = p.capsule((-w / 2 + 0.1, 0, 0), (w / 2 - 0.1, 0, 0), u(0.08, 0.13))
            a.add(roll, soft, (0, low + h + back, -d / 2 + 0.02))
    high = u(0.12, 0.3)
    for s in (-1, 1) if rng.random() < 0.8 else ():
        a.add(p.box((arm, h + high, d), soften), soft, (s * (w / 2 + arm / 2 - 0.02), low + (h + high) / 2, 0))
        if rng.random() < 0.5:
            roll = p.capsule((0, 0, -d / 2 + 0.1), (0, 0, d / 2 - 0.04), arm * 0.62)
            a.add(roll, soft, (s * (w / 2 + arm / 2), low + h + high, 0))
    for k in range(seats):
        x, c = (k - (seats - 1) / 2) * w / seats, u(0.1, 0.16)
        a.add(p.box((w / seats * 0.97, c, d * 0.85), c * 0.42), pillow, (x, low + h + c * 0.35, 0.06))
        if rng.random() < 0.6:
            a.add(p.box((w / seats * 0.9, 0.4, 0.16), 0.07).rotate((-14, 0, 0)), pillow, (x, low + h + 0.26, -d * 0.24))
    foot = p.cylinder(0.025, low + 0.05, top=0.04, segments=12)
    a.add_corners(foot, feet, w / 2 - 0.06, low / 2, d / 2 - 0.07)


def _drawers(a: Assembly, w: float, h: float, d: float, at: np.ndarray, part: int) -> None:
    """Block with protruding drawer fronts, gaps between them, and knobs or bars."""
    rng = a.rng
    a.add(p.box((w, h, d), 0.005), part, at)
    rows, columns = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    knob = a.part("metal" if rng.random() < 0.6 else "wood")
    front = part if rng.random() < 0.6 else a.part("paint" if rng.random() < 0.5 else "wood")
    bar = rng.random() < 0.4
    wide, tall = w / columns * 0.92, h / rows * 0.88
    grip = p.box((0.3 * wide, 0.015, 0.05), 0.005) if bar else p.ellipsoid((0.022, 0.022, 0.025), 16)
    for i, j in itertools.product(range(rows), range(columns)):
        x, y = ((j + 0.5) / columns - 0.5) * w, ((i + 0.5) / rows - 0.5) * h
        a.add(p.box((wide, tall, 0.04), 0.008), front, at + (x, y, d / 2))
        a.add(grip, knob, at + (x, y + 0.1 * tall, d / 2 + 0.04))


def shelf(a: Assembly) -> None:
    """Shelf, bookcase with books, cabinet, chest of drawers or cupboard."""
    rng, u = a.rng, a.rng.uniform
    wood = a.random_part("wood", "paint", "metal", p=[0.65, 0.25, 0.1])
    w, h, d, t = u(0.4, 1.2), u(0.5, 1.9), u(0.25, 0.55), u(0.015, 0.045)
    closed = rng.random()
    if closed < 0.4:
        _drawers(a, w, h, d, np.array([0, h / 2, 0]), wood)
    else:
        low = h * u(0.25, 0.5) if closed < 0.65 else 0.0
        if low:
            _drawers(a, w * 1.02, low, d * 1.05, np.array([0, low / 2, 0.02]), wood)
        for s in (-1, 1):
            a.add(p.box((t, h, d)), wood, (s * (w - t) / 2, h / 2, 0))
        heights = np.linspace(low, h - t, int(rng.integers(2, 6)) + (low == 0))
        for y in heights:
            a.add(p.box((w, t, d)), wood, (0, y + t / 2, 0))
        if rng.random() < 0.75:
            a.add(p.box((w, h, 0.015)), wood, (0, h / 2, -d / 2 + 0.008))
        books = [a.part("accent") for _ in range(3)] if rng.random() < 0.4 else []
        for y, top in zip(heights[:-1], heights[1:]) if books else ():
            x = -w / 2 + t
            while x < w / 2 - t - 0.12 and rng.random() < 0.92:
                wide, tall = u(0.03, 0.09), (top - y - t) * u(0.6, 0.92)
                book = p.box((wide, tall, d * u(0.6, 0.85)))
                a.add(book, books[int(rng.integers(3))], (x + wide / 2, y + t + tall / 2 - 1e-3, -0.05 * d))
                x += wide + u(-0.001, 0.004)
    if rng.random() < 0.5:
        a.add(p.box((w * 1.06, 0.04, d * 1.1), 0.012), wood, (0, h, 0))
    if rng.random() < 0.6:
        a.add_corners(p.cylinder(0.02, 0.12, top=0.03, segments=12), wood, w / 2 - 0.05, -0.05, d / 2 - 0.05)


def vehicle(a: Assembly) -> None:
    """Toy car, truck, cart or train: body and cabin of rounded or wedge-like blocks, wheels, bumpers, lamps."""
    rng, u = a.rng, a.rng.uniform
    paint, tire = a.part("paint"), a.part("rubber")
    hub, dark = a.part("metal"), a.part("accent")
    long, w, h, r = u(0.9, 1.6), u(0.4, 0.65), u(0.14, 0.34), u(0.1, 0.2)
    a.add(p.box((long, h, w), float(rng.choice([0.01, 0.04, 0.1]))), paint, (0, r + h / 2, 0))
    cabin, x, tall = u(0.25, 0.6) * long, u(-0.2, 0.2) * long, u(0.18, 0.4)
    top = p.wedge((cabin, tall, w * 0.9), u(0.5, 1.0), u(-0.1, 0.1))
    a.add(top, paint if rng.random() < 0.4 else dark, (x, r + h + tall / 2 - 0.01, 0))
    a.add(p.box((cabin * 0.6, 0.04, w * 0.88), 0.015), paint, (x, r + h + tall, 0))
    if rng.random() < 0.35:
        a.cut(p.box((long * 0.35, h, w * 0.85)), dark, (-0.28 * long, r + h * 1.25, 0))
    axles = np.linspace(-0.33, 0.33, int(rng.integers(2, 4))) * long
    wide = u(0.08, 0.16)
    for at in axles:
        for s in (-1, 1):
            a.add(p.cylinder(r, wide, bevel=0.025).rotate((90, 0, 0)), tire, (at, r, s * w / 2))
            a.add(p.cylinder(r * 0.55, wide * 1.1, bevel=0.01, segments=20).rotate((90, 0, 0)), hub, (at, r, s * w / 2))
    for s in (-1, 1):
        a.add(p.box((0.05, 0.06, w * 1.02), 0.02), hub, (s * long / 2, r + 0.06, 0))
        a.add(p.ellipsoid((0.03, 0.045, 0.045), 16), dark, (long / 2, r + h * 0.6, s * w * 0.35))
