"""Families of organic shapes: iso-surfaces of signed fields, negative inside, by surface nets (Gibson 1998)."""

from collections.abc import Sequence

import numpy as np

from reli3d.synthetic import primitives as p
from reli3d.synthetic.assembly import Assembly

CELLS = 52  # along the longest side: limbs of 4 % are two cells thick


class Field:
    """Approximate signed distances on a grid around a box, built by smooth unions."""

    def __init__(self, lowest: Sequence[float], highest: Sequence[float]):
        low, high = np.asarray(lowest, dtype=np.float32), np.asarray(highest, dtype=np.float32)
        self.step = float((high - low).max()) / CELLS
        self.low = low - 3 * self.step
        count = np.ceil((high - self.low) / self.step).astype(int) + 4
        steps = [self.step * np.arange(n, dtype=np.float32) for n in count]
        self.axes = [(low + step).astype(np.float32) for low, step in zip(self.low, steps)]
        self.value = np.full(tuple(count), 10.0, dtype=np.float32)
        self.label = np.zeros(tuple(count), dtype=np.int8)

    def limb(self, start, end, radius: float, tip: float, *, blend: float = 0.05, label: int = 0) -> None:
        """Smooth union with a tapered capsule."""
        start, end = np.asarray(start, dtype=np.float32), np.asarray(end, dtype=np.float32)
        line = end - start
        length = float(line @ line) + 1e-12
        margin = max(radius, tip) + blend * 2 + 2 * self.step
        window, (x, y, z) = self._window(np.minimum(start, end), np.maximum(start, end), margin)
        t = np.clip(((x - start[0]) * line[0] + (y - start[1]) * line[1] + (z - start[2]) * line[2]) / length, 0, 1)
        d = (x - start[0] - t * line[0]) ** 2 + (y - start[1] - t * line[1]) ** 2 + (z - start[2] - t * line[2]) ** 2
        self._join(window, np.sqrt(d) - (radius + t * (tip - radius)), blend, label)

    def ball(self, center, radii, *, blend: float = 0.05, label: int = 0) -> None:
        """Smooth union with an ellipsoid of half axes ``radii``."""
        center, radii = np.asarray(center, dtype=np.float32), np.broadcast_to(np.asarray(radii, dtype=np.float32), 3)
        window, (x, y, z) = self._window(center - radii, center + radii, blend * 2 + 2 * self.step)
        x, y, z = ((v - c) / r for v, c, r in zip((x, y, z), center, radii))
        self._join(window, (np.sqrt(x**2 + y**2 + z**2) - 1) * float(radii.min()), blend, label)

    def ripple(self, rng: np.random.Generator, amplitude: float, wave: float) -> None:
        """Adds six plane waves of wavelength about ``wave`` to the field."""
        x, y, z = np.meshgrid(*self.axes, indexing="ij", sparse=True)
        for _ in range(6):
            k = rng.normal(size=3).astype(np.float32)
            k *= 2 * np.pi / wave * rng.uniform(0.6, 1.5) / np.linalg.norm(k)
            phase = np.float32(rng.uniform(0, 6.28))
            self.value += np.float32(amplitude / 2.5) * np.sin(k[0] * x + k[1] * y + k[2] * z + phase)

    def add_to(self, a: Assembly, parts: list[int]) -> None:
        """Adds the closed surface to ``a``; a face belongs to ``parts[label]`` of the primitive nearest to it."""
        border = [0, 1, -2, -1]
        self.value[border] = self.value[:, border] = self.value[:, :, border] = 1.0
        vertices, faces = surface_nets(self.value)
        solid = p.from_arrays(vertices * self.step + self.low, faces).simplify(0.06 * self.step)
        mesh = solid.to_mesh()
        points, faces = np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts)
        index = np.rint((points[faces].mean(1) - self.low) / self.step).astype(int)
        label = self.label[tuple(np.clip(index, 0, np.array(self.value.shape) - 1).T)]
        a.add_labeled(points, faces, np.array(parts)[label])

    def _window(self, low, high, margin):
        a = np.floor((low - margin - self.low) / self.step).astype(int).clip(0)
        b = np.ceil((high + margin - self.low) / self.step).astype(int) + 1
        window = tuple(slice(int(i), int(max(j, i + 1))) for i, j in zip(a, b))
        return window, np.meshgrid(*[x[s] for x, s in zip(self.axes, window)], indexing="ij", sparse=True)

    def _join(self, window, value, blend, label):
        old = self.value[window]
        self.label[window] = np.where(value < old, np.int8(label), self.label[window])
        h = np.maximum(np.float32(blend) - np.abs(old - value), 0) / np.float32(max(blend, 1e-6))
        self.value[window] = np.minimum(old, value) - h * h * np.float32(blend * 0.25)  # quadratic smooth minimum


def surface_nets(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices ``(V, 3)`` in grid units and outward triangles ``(F, 3)`` of the zero iso-surface of ``value``."""
    inside = value < 0
    shape = np.array(value.shape) - 1
    quads, points = [], []
    for axis in range(3):
        lower, upper = [slice(None)] * 3, [slice(None)] * 3
        lower[axis], upper[axis] = slice(None, -1), slice(1, None)
        at = np.argwhere(inside[tuple(lower)] != inside[tuple(upper)])
        step = np.eye(3, dtype=int)[axis]
        a, b = value[tuple(at.T)], value[tuple((at + step).T)]
        point = at.astype(np.float32)
        point[:, axis] += a / (a - b)
        s, t = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
        quad = np.stack([np.ravel_multi_index(tuple(c.T), tuple(shape)) for c in (at, at - s, at - s - t, at - t)], -1)
        quads.append(np.where((a < 0)[:, None], quad, quad[:, ::-1]))
        points.append(point)
    quad = np.concatenate(quads)
    used, index = np.unique(quad, return_inverse=True)
    index = index.reshape(-1, 4)
    crossing = np.repeat(np.concatenate(points), 4, axis=0)
    total = [np.bincount(index.ravel(), weights=crossing[:, k]) for k in range(3)]
    vertices = np.stack(total, -1) / np.bincount(index.ravel())[:, None]
    return vertices, np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])


def creature(a: Assembly) -> None:
    """Quadruped or bird: body, neck, head with snout, ears or horns, eyes, tail; sometimes on a plinth."""
    rng, u = a.rng, a.rng.uniform
    statue = rng.random() < 0.35
    skin = a.random_part(*("stone metal ceramic wood" if statue else "skin plastic fabric").split())
    other = skin if statue or rng.random() < 0.5 else a.part("skin")
    long, tall, fat = u(0.3, 0.6), u(0.12, 0.5), u(0.08, 0.2)
    f = Field((-0.75, -0.02, -0.32), (0.95, 1.25, 0.32))
    back, blend, y = np.array([-long / 2, tall + fat, 0]), u(0.03, 0.1), tall + fat
    front = np.array([long / 2, tall + fat * u(0.9, 1.5), 0])
    f.limb(back, front, fat * u(0.8, 1.1), fat * u(0.8, 1.15), blend=blend)
    head = front + np.array([u(0.05, 0.28), u(0.0, 0.4), 0])
    size = fat * u(0.5, 0.95)
    f.limb(front, head, fat * u(0.5, 0.8), size * 0.8, blend=blend)
    f.ball(head, size * u(0.85, 1.2, 3), blend=blend)
    nose = head + np.array([size * u(1.0, 2.0), -size * u(0, 0.7), 0])
    f.limb(head, nose, size * 0.6, size * u(0.25, 0.5), blend=0.03, label=int(rng.integers(2)))
    thick, bird = fat * u(0.22, 0.45), rng.random() < 0.2
    for x in (0.0,) if bird else (-long / 2, long / 2):
        for s in (-1, 1):
            hip = np.array([x, y - 0.3 * fat, s * fat * 0.6])
            knee = hip * (1, 0.5, 1.1) + (u(-0.08, 0.08), 0, 0)
            foot = np.array([x + u(-0.06, 0.1), thick * 0.4, s * fat * u(0.6, 0.9)])
            f.limb(hip, knee, thick * 1.5, thick, blend=blend)
            f.limb(knee, foot, thick, thick * 0.8, blend=0.03)
            f.limb(foot, foot + (0.06, 0, 0), thick * 0.8, thick * 0.7, blend=0.03, label=1)
    for s in (-1, 1):
        ear = head + np.array([-0.2 * size, 0.7 * size, s * 0.5 * size])
        end = ear + np.array([u(-1, 0.4), u(0.2, 1.6), s * u(0, 1)]) * size
        f.limb(ear, end, size * 0.3, size * u(0.08, 0.3), blend=0.02, label=1)
        if bird:
            f.ball((-0.05, y, s * fat), (long * 0.55, fat * 0.6, 0.06), blend=0.04, label=1)
    moves = np.concatenate([np.zeros((1, 3)), u([-0.2, -0.2, -0.1], [-0.02, 0.2, 0.1], (3, 3))])
    tail = p.curve(back + np.cumsum(moves, 0), 6)
    for k in range(5):
        f.limb(tail[k], tail[k + 1], thick * (1.1 - 0.15 * k), thick * (1 - 0.15 * k), blend=0.03)
    if rng.random() < 0.3:
        f.ripple(rng, u(0.005, 0.015), 0.12)
    f.add_to(a, [skin, other])
    if not statue:
        eye = a.part("accent")
        for s in (-1, 1):
            a.add(p.ellipsoid(np.full(3, size * 0.2), 12), eye, head + np.array([0.62, 0.35, s * 0.62]) * size)
    if statue or rng.random() < 0.1:
        base = a.random_part("wood", "stone", "metal")
        if rng.random() < 0.5:
            a.add(p.box((long + 0.4, u(0.05, 0.2), 0.5), 0.02), base, (0, -0.02, 0))
        else:
            a.add(p.cylinder(0.36, u(0.05, 0.15), bevel=0.02).scale((1.1, 1, 0.8)), base, (0, -0.02, 0))


def figure(a: Assembly) -> None:
    """Standing or sitting figure, doll, bear or bust, with clothes as parts, optionally on a base."""
    rng, u = a.rng, a.rng.uniform
    kind = str(rng.choice(["stone", "metal", "skin", "plastic", "fabric", "wood"]))
    skin = a.part(kind)
    plain = kind in ("stone", "metal", "wood")
    cloth, hair = (skin, skin) if plain else (a.part("fabric"), a.part("accent"))
    plump, hip, head = u(0.7, 1.8), u(0.25, 0.5), u(0.07, 0.17)
    f = Field((-0.55, -0.02, -0.35), (0.55, hip + 0.9, 0.4))
    chest = hip + u(0.22, 0.34)
    wide, blend = 0.09 * plump, u(0.02, 0.07)
    f.limb((0, hip, 0), (0, chest, 0), 0.1 * plump, 0.11 * plump, blend=blend, label=1)
    top = np.array([0, chest + 0.1 * plump + head * 0.8, u(0, 0.05)])
    f.limb((0, chest, 0), top, 0.05, 0.045, blend=blend)
    f.ball(top + (0, 0.4 * head, 0), head * np.array([0.85, 1.1, 0.95]), blend=0.03)
    f.ball(top + (0, 0.75 * head, -0.3 * head), head * np.array([0.9, 0.85, 0.85]), blend=0.01, label=2)
    f.ball(top + (0, 0.2 * head, 0.9 * head), head * 0.2, blend=0.03)
    seated = rng.random() < 0.25
    for s in (-1, 1):
        shoulder = np.array([s * 1.2 * wide, chest + 0.03, 0])
        elbow = shoulder + np.array([s * u(0.05, 0.2), u(-0.2, 0.08), u(-0.05, 0.1)])
        hand = elbow + np.array([s * u(-0.12, 0.12), u(-0.2, 0.2), u(0.0, 0.2)])
        arm = 0.034 * np.sqrt(plump)
        f.limb(shoulder, elbow, arm * 1.3, arm * 1.1, blend=blend, label=1)
        f.limb(elbow, hand, arm * 1.1, arm * 0.9, blend=0.02)
        f.ball(hand, arm * 1.2, blend=0.02)
        top_leg = np.array([s * 0.6 * wide, hip, 0])
        knee = np.array([s * u(0.5, 1.0) * wide, hip * (0.95 if seated else 0.55), 0.24 if seated else u(-0.03, 0.06)])
        foot = np.array([knee[0] + s * 0.02, hip * 0.5 if seated else 0.03, knee[2] + u(-0.06, 0.02)])
        f.limb(top_leg, knee, 0.06 * plump, 0.05 * np.sqrt(plump), blend=blend, label=1)
        f.limb(knee, foot, 0.047 * np.sqrt(plump), 0.035 * np.sqrt(plump), blend=0.02, label=1)
        f.limb(foot, foot + (0, 0, 0.09), 0.036 * np.sqrt(plump), 0.033, blend=0.02, label=2)
        if rng.random() < 0.2:
            f.ball(top + (s * head * 0.8, 1.2 * head, 0), head * 0.4, blend=0.02)
    if rng.random() < 0.25:
        f.limb((0, hip * 0.35, 0), (0, hip + 0.1, 0), u(0.16, 0.26), 0.09, blend=0.03, label=1)
    if rng.random() < 0.3:
        f.ripple(rng, u(0.004, 0.012), 0.1)
    f.add_to(a, [skin, cloth, hair])
    if rng.random() < 0.25:  # a bust
        a.keep_inside(p.box((2, 2, 2)).translate((0, hip + 1.12, 0)), skin)
        a.add(p.cylinder(0.16, 0.18, top=0.09, bevel=0.01), a.part("stone"), (0, hip + 0.04, 0))
    elif plain or rng.random() < 0.2:
        base = p.box((0.5, u(0.04, 0.3), 0.45), 0.02)
        a.add(base, a.part("stone" if rng.random() < 0.5 else "wood"), (0, -0.03, 0.03))
    elif seated:
        a.add(p.box((0.36, hip * 0.85, 0.34), 0.02), a.part("wood"), (0, hip * 0.42, -0.02))


def shoe(a: Assembly) -> None:
    """Shoe or boot with sole, heel and opening; one or a pair."""
    rng, u = a.rng, a.rng.uniform
    upper = a.random_part("leather", "fabric", "rubber")
    sole, accent = a.part("rubber"), a.part("accent")
    long, shaft, wide, heel = u(0.75, 1.0), u(0.16, 0.75), u(0.14, 0.2), u(0.0, 0.14)
    f = Field((-0.6, -0.05, -0.3), (0.6, 0.3 + shaft, 0.3))
    back, toe = np.array([-long / 2 + 0.14, 0.1 + heel, 0]), np.array([long / 2 - 0.13, 0.07, 0])
    f.limb(back, toe, wide * 0.75, wide * u(0.55, 0.85), blend=0.05)
    f.limb(toe - (0.2, 0, 0), toe, wide * 0.95, wide * 0.7, blend=0.06, label=int(rng.integers(2)))
    f.limb(back, (back[0], 0.2 + shaft, 0), wide * 0.8, wide * u(0.6, 0.9), blend=0.1)
    f.limb((back[0] + 0.05, 0.2 + shaft * 0.5, 0), toe - (0.12, -0.04, 0), wide * 0.6, wide * 0.6, blend=0.1)
    f.add_to(a, [upper, accent])
    a.keep_inside(p.box((3, 2, 3)).translate((0, 1.01, 0)).trim_by_plane((0, -1, 0), -(0.12 + shaft)), upper)
    hole = p.capsule((back[0], 0.24, 0), (back[0] + u(0, 0.1), 0.6 + shaft, 0), wide * 0.55, tip=wide * 0.6)
    a.cut(hole, accent)
    thick, turn = u(0.03, 0.09), np.linspace(0, 2 * np.pi, 41)[:-1]
    outline = np.stack([long / 2 * np.cos(turn) * 1.02, wide * (1.02 + 0.15 * np.cos(turn)) * np.sin(turn)], -1)
    a.add(p.prism(outline, thick, bevel=0.012), sole, (0.0, thick / 2 - 0.03, 0))
    a.add(p.box((0.26, thick + heel, 1.7 * wide), 0.04), sole, (-long / 2 + 0.15, (thick + heel) / 2 - 0.03, 0))
    for k in range(int(rng.integers(0, 5))):
        x, y = back[0] + 0.16 + 0.06 * k, 0.26 + 0.1 * shaft - 0.03 * k
        a.add(p.capsule((x, y, -0.5 * wide), (x, y, 0.5 * wide), 0.016), accent)


def fruit(a: Assembly) -> None:
    """Fruit, vegetable, gourd, egg or mushroom: lobed bodies of revolution with stalk, bend and dents."""
    rng, u = a.rng, a.rng.uniform
    skin = a.random_part("skin", "accent", "plastic", "ceramic")
    stalk = a.part("wood")
    count = int(rng.integers(5, 7))
    knots = np.concatenate([[0.02], u(0.25, 0.62, count - 2), [0.02]])
    tall, lobes, depth = u(0.5, 1.8), int(rng.integers(3, 11)), u(0, 0.16) * (rng.random() < 0.5)
    fine = p.curve(np.stack([knots, np.linspace(0, tall, count)], -1), 36)
    fine[:, 0] = fine[:, 0].clip(0.005)
    bend, dent = u(-0.5, 0.5) * (rng.random() < 0.4), u(0, 0.25)
    a.add(p.solid_of_profile(fine[:, 0], np.maximum.accumulate(fine[:, 1]), 48), skin)

    def move(q: np.ndarray) -> np.ndarray:
        r, angle = np.hypot(q[:, 0], q[:, 2]), np.arctan2(q[:, 2], q[:, 0])
        scale = 1 - depth * (0.5 + 0.5 * np.cos(lobes * angle))
        h = q[:, 1] / tall
        lift = dent * tall * (np.exp(-((r / 0.2) ** 2)) * np.where(h < 0.5, 1, -1)) * 0.4
        return np.stack([q[:, 0] * scale + bend * (h - 0.5) ** 2, q[:, 1] + lift, q[:, 2] * scale], -1)

    a.warp(move, 0.09)
    if rng.random() < 0.7:
        top = tall * (1 - 0.4 * dent) + bend * 0
        x = bend / 4
        path = p.curve([[x, top - 0.08, 0], [x, top + 0.08, 0], [x + u(-0.1, 0.1), top + u(0.1, 0.3), 0]], 8)
        a.add(p.tube(path, np.linspace(0.045, 0.03, 8), segments=8), stalk)
    if rng.random() < 0.3:
        leaf = a.part("skin")
        for k in range(int(rng.integers(1, 7))):
            blade = p.ellipsoid((0.2, 0.012, 0.08), 16).translate((0.2, 0, 0)).rotate((0, 0, u(10, 70)))
            a.add(blade.rotate((0, 57 * k, 0)), leaf, (bend / 4, tall * (1 - 0.4 * dent), 0))


def stone(a: Assembly) -> None:
    """Stone, shell, loaf or abstract sculpture: smooth unions of ellipsoids with waves, sometimes pierced."""
    rng, u = a.rng, a.rng.uniform
    body = a.random_part("stone", "skin", "ceramic", "fabric", "metal")
    other = body if rng.random() < 0.6 else a.part("accent")
    f = Field((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6))
    stretch = u(0.4, 1.0, 3)
    for k in range(int(rng.integers(1, 8))):
        center = u(-0.32, 0.32, 3) * stretch if k else np.zeros(3)
        radii = u(0.1, 0.28) * np.exp(rng.normal(0, 0.25, 3)).clip(0.6, 1.6) if k else 0.42 * stretch
        f.ball(center, radii, blend=u(0.02, 0.15), label=int(k > 2))
    f.ripple(rng, u(0, 0.05), u(0.25, 0.8))
    if rng.random() < 0.4:
        f.ripple(rng, u(0.003, 0.015), u(0.08, 0.2))
    f.add_to(a, [body, other])
    if rng.random() < 0.2:
        a.cut(p.cylinder(u(0.06, 0.2), 3).rotate(tuple(u(-90, 90, 3))), other)
    if rng.random() < 0.4:  # flat underside
        a.keep_inside(p.box((4, 4, 4)).translate((0, 2 - u(0.15, 0.3), 0)), body)
    if rng.random() < 0.25:
        a.add(p.cylinder(0.3, 0.12, bevel=0.02), a.part("wood"), (0, -0.36, 0))
