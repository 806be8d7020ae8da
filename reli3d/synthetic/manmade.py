"""Families of man-made objects: primitives with booleans, devices, tools, extruded outlines.

A family is a function ``family(assembly)`` that draws from ``assembly.rng`` and adds solids, +Y up, of about size 1.
"""

import itertools

import numpy as np
from manifold3d import CrossSection, Manifold

from reli3d.synthetic import primitives as p
from reli3d.synthetic.assembly import ON_BACK, ON_SIDE, Assembly


def csg(a: Assembly) -> None:
    """Two to eight primitives, mostly axis-aligned and touching, with unions, cuts and mirrored copies."""
    rng, u = a.rng, a.rng.uniform
    drawn = "plastic", "metal", "wood", "paint", "stone", "accent", "ceramic"
    roles = [a.random_part(*drawn) for _ in range(int(rng.integers(1, 4)))]
    size = u(0.35, 1.0, 3)
    a.add(primitive(rng, size), roles[0])
    for _ in range(int(rng.integers(1, 8))):
        part = roles[int(rng.integers(len(roles)))]
        small = size * u(0.15, 0.75, 3)
        face = int(rng.integers(6))
        axis, sign = face % 3, 1 if face < 3 else -1
        at = u(-0.3, 0.3, 3) * size
        at[axis] = sign * (size[axis] / 2 + small[axis] * u(-0.4, 0.42))
        if rng.random() < 0.4:
            at[(axis + 1) % 3] = 0.0
        solid = primitive(rng, small, free=rng.random() < 0.12).translate(tuple(at))
        mirror, turn = rng.random(), int(rng.integers(3, 8))
        copies = [solid]
        if mirror < 0.35:
            normal = np.eye(3)[(axis + 1 + int(rng.integers(2))) % 3]
            copies.append(solid.mirror(tuple(normal)))
        elif mirror < 0.5:
            copies = [solid.rotate((0, 360 * k / turn, 0)) for k in range(turn)]
        cut = rng.random() < 0.3
        for c in copies:
            whole = a.joined() if cut else None
            removes_little = whole is not None and whole.volume() - (whole - c).volume() < 0.6 * whole.volume()
            (a.cut if removes_little else a.add)(c, part)
    if rng.random() < 0.08:
        a.keep_inside(p.ellipsoid(np.full(3, 0.62) * size.max(), 40), roles[0])


def primitive(rng: np.random.Generator, size: np.ndarray, *, free: bool = False) -> Manifold:
    """A random primitive with a bounding box of about ``size``, rotated by multiples of 90 degrees or freely."""
    u = rng.uniform
    kind = int(rng.choice(10, p=[0.3, 0.2, 0.05, 0.07, 0.06, 0.08, 0.07, 0.09, 0.05, 0.03]))
    segments = int(rng.choice([6, 8, 24, 32, 40], p=[0.06, 0.06, 0.28, 0.4, 0.2]))
    match kind:
        case 0:
            return _turn(rng, p.box(size, float(size.min() * rng.choice([0, 0.03, 0.08, 0.2, 0.4]))), free, False)
        case 1:
            solid = p.cylinder(0.5, 1.0, bevel=float(rng.choice([0, 0.02, 0.08])), segments=segments)
        case 2:
            solid = p.cylinder(0.5, 1.0, top=u(0.02, 0.2), segments=segments)
        case 3:
            solid = p.cylinder(0.5, 1.0, top=u(0.25, 0.45), bevel=0.02, segments=segments)
        case 4:
            solid = p.capsule((0, -0.25, 0), (0, 0.25, 0), 0.25)
        case 5:
            solid = p.ellipsoid((0.5, 0.5, 0.5))
        case 6:
            tube = u(0.06, 0.2)
            solid = p.torus(0.5 - tube, tube).scale((1, 1 / (2 * tube), 1))
            size = np.array([size[0], min(size[1], 2 * tube * size.max()), size[2]])
        case 7:
            count = int(rng.integers(3, 9))
            turn = np.linspace(0, 2 * np.pi, count + 1)[:-1]
            solid = p.prism(0.5 * np.stack([np.cos(turn), np.sin(turn)], -1), 1.0, bevel=float(rng.choice([0, 0.04])))
        case 8:
            solid = p.wedge((1, 1, 1), u(0, 0.7), u(-0.6, 0.6))
        case _:
            solid = p.prism(star(rng), 1.0, bevel=0.03)
    return _turn(rng, solid.scale(tuple(size)), free, kind in (1, 2, 3, 4, 7))


def _turn(rng: np.random.Generator, solid: Manifold, free: bool, round_body: bool) -> Manifold:
    if free:
        return solid.rotate(tuple(rng.uniform(-180, 180, 3)))
    if round_body and rng.random() < 0.35:
        return solid.rotate((90.0, 0, 0) if rng.random() < 0.5 else (0, 0, 90.0))
    return solid


def star(rng: np.random.Generator) -> np.ndarray:
    """Star, gear or flower outline ``(K, 2)`` of radius 0.5."""
    teeth, depth = int(rng.integers(4, 15)), rng.uniform(0.1, 0.45)
    turn = np.linspace(0, 2 * np.pi, 8 * teeth + 1)[:-1]
    wave = np.clip(np.cos(teeth * turn) * rng.choice([1.0, 4.0]), -1, 1)
    radius = 0.5 * (1 - depth * (0.5 - 0.5 * wave))
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], -1)


def device(a: Assembly) -> None:
    """Rounded body with a lens or dials, knobs, keys, a screen, feet and an antenna: camera, radio, toy, appliance."""
    rng, u = a.rng, a.rng.uniform
    w, h, d = u(0.6, 1.3), u(0.35, 1.1), u(0.15, 0.8)
    body = a.random_part("plastic", "paint", "metal", "wood", p=[0.5, 0.2, 0.15, 0.15])
    trim = a.random_part("metal", "accent", "plastic")
    dark = a.part("rubber")
    bevel = float(rng.choice([0.01, 0.03, 0.08, 0.18])) * min(w, h, d) / 0.5
    a.add(p.box((w, h, d), bevel), body)
    if rng.random() < 0.3:  # a second block on top or a band around
        block = p.box((w * u(0.25, 0.6), h * u(0.15, 0.4), d * u(0.6, 0.95)), bevel)
        a.add(block, body if rng.random() < 0.5 else trim, (u(-0.2, 0.2) * w, h * 0.55, 0))
    if rng.random() < 0.35:
        a.add(p.box((w * 1.01, h * u(0.15, 0.5), d * 1.02), bevel), dark, (0, u(-0.2, 0.15) * h, 0))
    front, kind = d / 2, rng.random()
    if kind < 0.4:  # lens
        r, x, y, out = u(0.2, 0.42) * min(w, h), u(-0.2, 0.2) * w, u(-0.12, 0.1) * h, u(0.08, 0.5)
        for k, scale in enumerate(np.sort(u(0.7, 1.05, int(rng.integers(1, 4))))[::-1]):
            part, length = (dark, trim, body)[int(rng.integers(3))], out * (0.5 + 0.4 * k)
            a.add(p.cylinder(r * scale, length, bevel=0.02).rotate((90, 0, 0)), part, (x, y, front + length / 2 - 0.02))
            end = front + length - 0.02
        a.cut(p.cylinder(r * 0.55, 0.1, top=r * 0.6).rotate((90, 0, 0)), dark, (x, y, end))
        a.add(p.ellipsoid((r * 0.56, r * 0.56, 0.05)), a.part("accent"), (x, y, end - 0.05))
    elif kind < 0.65:  # loudspeakers or dials
        count = int(rng.integers(1, 4))
        r = min(0.42 * w / count, 0.4 * h)
        for k in range(count):
            x = (k - (count - 1) / 2) * w / count
            a.add(p.torus(r * 0.85, r * 0.08).rotate((90, 0, 0)), trim, (x, 0, front))
            a.cut(p.cylinder(r * 0.78, 0.08, top=r * 0.5).rotate((-90, 0, 0)), dark, (x, 0, front))
            a.add(p.ellipsoid((r * 0.3, r * 0.3, 0.05)), dark, (x, 0, front - 0.04))
    elif kind < 0.85:  # screen
        a.cut(p.box((w * u(0.5, 0.9), h * u(0.4, 0.8), 0.05), 0.01), a.part("accent"), (0, u(0, 0.08) * h, front))
    if rng.random() < 0.5:  # rows of keys
        rows, cols = int(rng.integers(1, 5)), int(rng.integers(2, 7))
        size, low = min(0.7 * w / cols, 0.3 * h / rows) * 0.8, u(-0.45, -0.3) * h + 0.08 * h
        keys = a.random_part("plastic", "accent", "rubber")
        key = p.cylinder(size / 2, 0.06, bevel=0.01, segments=16).rotate((90, 0, 0))
        if rng.random() < 0.6:
            key = p.box((size, size, 0.06), 0.15 * size)
        for i, j in itertools.product(range(rows), range(cols)):
            a.add(key, keys, ((j - (cols - 1) / 2) * size * 1.25, low + i * size * 1.25, front))
    for _ in range(int(rng.integers(0, 4))):  # knobs on top or front
        r, tall = u(0.03, 0.1) * w, u(0.04, 0.14)
        knob = p.cylinder(r, tall, top=r * u(0.8, 1), bevel=0.01, segments=20)
        if rng.random() < 0.6:
            a.add(knob, (trim, dark)[int(rng.integers(2))], (u(-0.42, 0.42) * w, h / 2 + tall * 0.4, u(-0.3, 0.3) * d))
        else:
            a.add(knob.rotate((90, 0, 0)), trim, (u(-0.4, 0.4) * w, u(-0.4, 0.4) * h, front + tall * 0.4))
    if rng.random() < 0.3:  # carrying handle
        rise = h / 2 + np.array([-0.03, 0.18, u(0.2, 0.3), 0.18, -0.03])
        path = np.stack([0.4 * w * np.array([-1, -0.9, 0, 0.9, 1]), rise, np.zeros(5)], -1)
        a.add(p.tube(p.curve(path, 24), u(0.02, 0.04), segments=10), trim)
    if rng.random() < 0.15:
        antenna = p.cylinder(0.012, u(0.4, 0.8), segments=8).rotate((0, 0, u(-30, 30)))
        a.add(antenna, trim, (0.4 * w * rng.choice([-1, 1]), h * 0.7, -0.2 * d))
    if rng.random() < 0.35:
        a.add_corners(p.cylinder(0.045, 0.1, top=0.05, segments=16), dark, 0.38 * w, -h / 2 - 0.03, 0.35 * d)
    if rng.random() < 0.12:  # on its back: keypad, telephone
        a.transform(ON_BACK)


def tool(a: Assembly) -> None:
    """Handle and head: hammer, axe, brush, screwdriver, sword, spoon, spanner, magnifier; upright or lying."""
    rng, u = a.rng, a.rng.uniform
    grip, head = a.random_part("wood", "plastic", "rubber"), a.part("metal")
    tall, r, kind = u(0.7, 1.2), u(0.03, 0.07), int(rng.integers(6))
    y = np.linspace(0, tall, 20)
    shape = r * (1 + 0.25 * np.sin(y / tall * u(3, 9) + u(0, 6))) * np.linspace(1.15, 0.85, 20)
    a.add(p.solid_of_profile(shape, y, 24).scale((1, 1, u(0.7, 1))), grip)
    if kind == 0:  # hammer
        a.add(p.box((u(0.3, 0.5), u(0.12, 0.2), u(0.12, 0.18)), 0.03), head, (u(-0.08, 0.08), tall, 0))
        a.add(p.cylinder(u(0.07, 0.11), 0.12, bevel=0.015).rotate((0, 0, 90)), head, (0.25, tall, 0))
    elif kind == 1:  # axe or spade
        upper, tip, lower = (u(0.25, 0.45), u(0.15, 0.3)), (u(0.3, 0.48), 0), (u(0.25, 0.45), -u(0.15, 0.3))
        outline = np.array([(0, 0.09), upper, tip, lower, (0, -0.09)])
        a.add(p.prism(outline, u(0.04, 0.09), bevel=0.012).rotate((90, 0, 0)), head, (0, tall * 0.92, 0))
        a.add(p.box((0.16, 0.2, 0.12), 0.02), head, (0, tall * 0.92, 0))
    elif kind == 2:  # blade with guard
        w, long = u(0.06, 0.14), u(0.8, 1.8)
        a.add(p.wedge((2 * w, long, u(0.02, 0.05)), u(0.05, 0.6)), head, (0, tall * 0.4 + long / 2, 0))
        a.add(p.box((u(0.25, 0.5), 0.06, 0.1), 0.02), a.part("accent"), (0, tall * 0.42, 0))
        a.add(p.ellipsoid((0.08, 0.07, 0.07)), head)
    elif kind == 3:  # shaft: screwdriver, awl, brush
        a.add(p.cylinder(r * 0.4, u(0.4, 0.9), top=r * 0.3, segments=16), head, (0, tall * 1.2, 0))
        if rng.random() < 0.5:
            a.add(p.box((u(0.2, 0.4), 0.2, u(0.05, 0.15)), 0.03), a.part("fabric"), (0, tall * 1.55, 0))
    elif kind == 4:  # ring: magnifier, racket, pan
        r2 = u(0.25, 0.4)
        a.add(p.torus(r2, u(0.03, 0.06)).rotate((90, 0, 0)), head, (0, tall + r2 * 0.95, 0))
        if rng.random() < 0.7:
            a.add(p.cylinder(r2, 0.03).rotate((90, 0, 0)), a.part("accent"), (0, tall + r2 * 0.95, 0))
    else:  # spoon, ladle, club
        a.add(p.ellipsoid((u(0.12, 0.25), u(0.15, 0.3), u(0.05, 0.2))), head, (0, tall * 1.1, 0))
        if rng.random() < 0.5:
            a.cut(p.ellipsoid((0.1, 0.14, 0.12)), head, (0, tall * 1.1, 0.12))
    if rng.random() < 0.5:
        a.transform(ON_SIDE)
    if rng.random() < 0.25:  # on a stand
        low = a.joined().bounding_box()
        stand = p.box((max(low[3] - low[0], 0.3) * 0.9, 0.08, 0.35), 0.02)
        a.add(stand, a.part("wood"), ((low[0] + low[3]) / 2, low[1] - 0.02, 0))


def profile(a: Assembly) -> None:
    """Extruded outlines and tubes: letters made of bars, gears, brackets, signs with rims, horns and knots."""
    rng, u = a.rng, a.rng.uniform
    part = a.random_part("metal", "plastic", "wood", "paint", "stone")
    kind = int(rng.integers(5))
    if kind == 0:  # letters of bars on a 3 x 4 grid, side by side
        for k in range(int(rng.integers(1, 4))):
            cells = rng.random((4, 3)) < 0.62
            cells[:, 0] |= rng.random() < 0.7
            for y, x in zip(*np.nonzero(cells)):
                a.add(p.box((0.27, 0.27, 0.3), 0.01), part, (x * 0.25 + k * 0.95, y * 0.25, 0))
        if rng.random() < 0.5:
            low = a.joined().bounding_box()
            a.add(p.box((low[3] - low[0] + 0.2, 0.12, 0.5), 0.02), a.part("wood"), ((low[0] + low[3]) / 2, -0.18, 0))
    elif kind == 1:  # gear or wheel
        hole, thick = u(0.06, 0.3), u(0.08, 0.4)
        a.add(p.prism(star(rng), thick, bevel=0.015), part)
        a.add(p.cylinder(hole + 0.06, thick * u(1.1, 1.6), bevel=0.01), part)
        a.cut(p.cylinder(hole, 2), part)
        if rng.random() < 0.5:
            count = int(rng.integers(3, 8))
            for t in 2 * np.pi * np.arange(count) / count:
                a.cut(p.cylinder(0.06, 2, segments=20), part, (0.31 * np.cos(t), 0, 0.31 * np.sin(t)))
        if rng.random() < 0.7:
            a.transform(ON_BACK)
    elif kind == 2:  # smooth plate with holes: bracket, guitar body, palette
        turn = np.linspace(0, 2 * np.pi, 9)[:-1]
        outline = p.curve(np.stack([np.cos(turn) * u(0.5, 1, 8), np.sin(turn) * u(0.4, 0.9, 8)], -1), 64, closed=True)
        section, thick = CrossSection([outline]), u(0.06, 0.35)
        a.add(p.prism(outline, thick, bevel=0.02).rotate((90, 0, 0)), part)
        if rng.random() < 0.5:
            rim = [np.asarray(c) for c in (section - section.offset(-0.08)).to_polygons()]
            a.add(p.prism(rim, thick * 1.4).rotate((90, 0, 0)), a.part("accent"))
        for _ in range(int(rng.integers(0, 4))):
            a.cut(p.cylinder(u(0.05, 0.14), 2).rotate((90, 0, 0)), part, (*u(-0.35, 0.35, 2), 0))
    elif kind == 3:  # knot or closed loop
        turn = np.linspace(0, 2 * np.pi, 121)[:-1]
        q, r = (2, 3) if rng.random() < 0.5 else (1, int(rng.integers(2, 5)))
        wide = 1 + u(0.15, 0.4) * np.cos(r * turn)
        path = np.stack([wide * np.cos(q * turn), u(0.2, 0.4) * np.sin(r * turn), wide * np.sin(q * turn)], -1)
        a.add(p.tube(path, u(0.07, 0.14), closed=True, segments=14), part)
        if rng.random() < 0.5:
            a.transform(ON_BACK)
    else:  # horn: a coiled tube that opens
        turns, count = u(0.6, 2.2), 90
        done = np.linspace(0, 1, count)
        angle, radius = 2 * np.pi * turns * done, 0.25 + 0.35 * done
        path = np.stack([radius * np.cos(angle), radius * np.sin(angle), u(0.1, 0.5) * done], -1)
        width = u(0.02, 0.05) + 0.06 * done + u(0.05, 0.25) * np.maximum(done - 0.8, 0) ** 2 / 0.04
        a.add(p.tube(path, width, segments=18), part)
        tangent = path[-1] - path[-2]
        inside = p.capsule(path[-1] - 2 * tangent, path[-1] + 4 * tangent, width[-1] * 0.5, tip=width[-1] * 0.9)
        a.cut(inside, a.part("metal"))
