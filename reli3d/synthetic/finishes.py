"""Random materials by the roles of parts: mostly grays, browns, whites and dark plastics.  Colors: linear Rec. 709."""

from collections.abc import Sequence

import numpy as np

from reli3d.synthetic import patterns as pt
from reli3d.synthetic.materials import Coat, Layer, Material, SurfaceFunction

METAL_PROBABILITY = 0.36  # that an object may have metal parts; not all of these have a suitable part
# F0 of steel, aluminum, gold, brass, copper, bronze, iron, gunmetal, as published tables give them
METALS = (
    (0.56, 0.57, 0.58), (0.88, 0.88, 0.89), (0.9, 0.72, 0.32), (0.86, 0.72, 0.42),
    (0.88, 0.6, 0.48), (0.6, 0.45, 0.26), (0.5, 0.49, 0.47), (0.2, 0.2, 0.21),
)  # fmt: skip
METAL_WEIGHTS = (0.25, 0.17, 0.1, 0.13, 0.08, 0.07, 0.1, 0.1)
# oak, pine, walnut, birch, ebony, mahogany, maple
WOODS = (
    (0.3, 0.16, 0.07), (0.45, 0.29, 0.14), (0.16, 0.07, 0.03), (0.55, 0.4, 0.22),
    (0.08, 0.045, 0.028), (0.33, 0.12, 0.05), (0.62, 0.5, 0.33),
)  # fmt: skip


def draw_materials(rng: np.random.Generator, roles: Sequence[str], bounds: np.ndarray) -> tuple[Material, ...]:
    """One material per part.  roles: as in ``Assembly``.  bounds: ``(P, 2, 3)`` lowest and highest corner of a part."""
    draw = _Draw(rng)
    metal = rng.random() < METAL_PROBABILITY
    takes = [metal and role == "metal" for role in roles]
    if metal and not any(takes):
        takes[int(rng.integers(len(roles)))] = rng.random() < 0.7
    shared: dict[str, Material] = {}
    result = []
    for role, is_metal, box in zip(roles, takes, bounds):
        kind = "metal" if is_metal else ("plastic" if role == "metal" else role)
        if not is_metal and rng.random() < 0.12:
            kind = draw.pick("wood plastic paint fabric ceramic stone accent")
        if kind not in shared or rng.random() < 0.25:
            shared[kind] = draw.material(kind, box)
        result.append(shared[kind])
    return tuple(result)


def _rgb(values: np.ndarray) -> tuple[float, float, float]:
    red, green, blue = (float(x) for x in np.clip(values, 0.02, 0.88))
    return red, green, blue


def _linear_of_hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    ramp = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return (value * (1 - saturation + saturation * ramp)) ** 2.2  # the display curve, near enough for a random color


class _Draw:
    """Draws colors, patterns and materials.  The order of the draws is the order of evaluation."""

    def __init__(self, rng: np.random.Generator):
        self.rng, self.u = rng, rng.uniform

    def chance(self, probability: float) -> bool:
        return self.rng.random() < probability

    def seed(self) -> int:
        return int(self.rng.integers(1 << 20))

    def pick(self, words: str, p: Sequence[float] | None = None) -> str:
        return str(self.rng.choice(words.split(), p=p))

    def color(self, kind: str) -> tuple[float, float, float]:
        """Random linear base color of a palette: ``gray white dark wood muted vivid earth any``."""
        u, normal = self.u, self.rng.normal
        if kind == "any":
            kind = self.pick("gray white dark wood muted vivid earth", [0.17, 0.17, 0.15, 0.1, 0.2, 0.1, 0.11])
        match kind:
            case "gray":
                return _rgb(np.exp(u(np.log(0.04), np.log(0.6))) * np.exp(normal(0, 0.05, 3)))
            case "white":
                return _rgb(u(0.55, 0.88) * np.array([1.0, 1.0 - u(0, 0.06), 1.0 - u(0, 0.2)]))
            case "dark":
                return _rgb(u(0.02, 0.06) * np.exp(normal(0, 0.12, 3)))
            case "wood":
                wood = np.array(WOODS[int(self.rng.integers(len(WOODS)))])
                return _rgb(wood * np.exp(normal(0, 0.2)) * np.exp(normal(0, 0.06, 3)))
            case "earth":
                return _rgb(_linear_of_hsv(u(0.02, 0.17), u(0.25, 0.75), u(0.2, 0.8)))
            case "muted":
                return _rgb(_linear_of_hsv(u(), u(0.08, 0.42), u(0.25, 0.88)))
            case _:
                return _rgb(_linear_of_hsv(u(), u(0.6, 0.97), u(0.35, 0.95)))

    def near(self, rgb: tuple, spread: float) -> tuple[float, float, float]:
        normal = self.rng.normal
        return _rgb(np.array(rgb) * np.exp(normal(0, spread)) * np.exp(normal(0, 0.2 * spread, 3)))

    def roughness(self, low: float, high: float) -> float:
        return float(self.u(0.08, 0.2) if self.chance(0.06) else self.u(low, high))

    def frame(self, low: float, high: float, *, stretch: float = 1.0, turned: float = 0.2) -> np.ndarray:
        """Random frame of ``low`` to ``high`` cycles per unit, permuted or, with probability ``turned``, rotated."""
        axes = np.eye(3)[self.rng.permutation(3)]
        if self.chance(turned):
            axes = np.linalg.qr(self.rng.normal(size=(3, 3)))[0]
        cycles = np.exp(self.u(np.log(low), np.log(high)))
        return np.ascontiguousarray((cycles * np.array([1.0, 1.0, 1.0 / stretch]))[:, None] * axes)

    def blotches(self, frame: np.ndarray, threshold: tuple, softness: tuple, **options) -> SurfaceFunction:
        """threshold, softness: ranges."""
        seed = self.seed()
        return pt.blotches(frame, self.u(*threshold), self.u(*softness), seed=seed, **options)

    def bump(self, frame: np.ndarray, low: float, high: float) -> SurfaceFunction:
        """Stretched noise of ``low`` to ``high`` steepness."""
        return pt.emboss(frame, self.seed(), self.u(low, high) / float(np.linalg.norm(frame[0])), octaves=1)

    def noise(self, low: float, high: float, steepness: float) -> SurfaceFunction:
        frame = self.frame(low, high)
        return pt.emboss(frame, self.seed(), steepness / float(np.linalg.norm(frame[0])), octaves=2)

    def material(self, role: str, box: np.ndarray) -> Material:
        u, color, chance = self.u, self.color, self.chance
        layers: list[Layer] = []
        bumps: list[SurfaceFunction] = []
        match role:
            case "wood":
                return self.wood(box)
            case "metal":
                return self.metal(box)
            case "fabric":
                base = Coat(color("any"), u(0.7, 1.0))
                if chance(0.6):
                    thread = self.frame(20, 70, turned=0.1)
                    layers.append((Coat(self.near(base.color, 0.35), base.roughness), pt.weave(thread)))
                    bumps.append(pt.weave_bump(thread, float(u(0.1, 0.35) / np.linalg.norm(thread[0]))))
                else:
                    bumps.append(self.noise(15, 50, u(0.04, 0.15)))
            case "leather":
                kind = self.pick("wood dark earth vivid white", [0.35, 0.3, 0.2, 0.1, 0.05])
                base = Coat(color(kind), u(0.3, 0.7))
                skin = self.frame(18, 50)
                creases = Coat(self.near(base.color, 0.3), min(base.roughness + 0.15, 1.0))
                seed = self.seed()
                layers.append((creases, pt.mosaic(skin, seed, border=0.12)))
                bumps.append(pt.emboss(skin, seed, float(u(0.15, 0.4) / np.linalg.norm(skin[0])), cellular=True))
            case "ceramic":
                base = Coat(color("white" if chance(0.4) else "any"), self.roughness(0.12, 0.5))
            case "stone":
                return self.stone()
            case "skin":
                base = Coat(color(self.pick("earth wood gray white muted vivid")), u(0.45, 0.9))
                if chance(0.5):
                    frame, mosaic = self.frame(3, 12), chance(0.4)
                    if mosaic:
                        spots = pt.mosaic(frame, self.seed(), fraction=u(0.2, 0.6))
                    else:
                        spots = self.blotches(frame, (-0.2, 0.4), (0.03, 0.2))
                    layers.append((Coat(color("any"), base.roughness), spots))
                if chance(0.4):
                    belly = Coat(color("white" if chance(0.5) else "earth"), base.roughness)
                    layers.append((belly, pt.facing((0, -1, 0), -0.2, 0.5, self.seed())))
                if chance(0.5):
                    bumps.append(self.noise(10, 40, u(0.02, 0.12)))
            case "rubber":
                base = Coat(color("dark" if chance(0.8) else "any"), u(0.45, 0.95))
            case "plastic":
                base = Coat(color("any" if chance(0.7) else "dark"), self.roughness(0.2, 0.65))
                if chance(0.25):
                    bumps.append(self.noise(40, 80, u(0.03, 0.1)))
            case _:  # paint, accent, any
                kind = "vivid" if role == "accent" and chance(0.5) else "any"
                base = Coat(color(kind), self.roughness(0.2, 0.85))
                if chance(0.22):
                    layers.append(self.wear())
        layers[:0] = self.decor(base, box, 0.42 if role in ("paint", "ceramic", "any") else 0.25)
        if chance(0.2):
            layers.append(self.dirt(base))
        return Material(base, tuple(layers), tuple(bumps), u(0, 0.12), u(0, 0.06), u(2, 8), self.seed())

    def decor(self, base: Coat, box: np.ndarray, chance: float) -> list[Layer]:
        """Decoration in a second color: bands, checks, dots, blotches, a gradient along an axis, cells, labels."""
        u, rng = self.u, self.rng
        second = Coat(self.color("any"), float(np.clip(base.roughness + rng.normal(0, 0.1), 0.1, 1)))
        size = float(np.max(box[1] - box[0]))
        layers: list[Layer] = []
        if self.chance(chance):
            match int(rng.choice(7, p=[0.25, 0.08, 0.1, 0.17, 0.2, 0.1, 0.1])):
                case 0:
                    frame = self.frame(min(1.5 / size, 10), 14, turned=0.15)
                    if self.chance(0.5):
                        frame = frame[[int(np.argmax(np.abs(frame[:, 1]))), 0, 1]]  # horizontal bands
                    pattern = pt.bands(frame, u(0.15, 0.7), u(), u(0, 0.5) * self.chance(0.25), self.seed())
                case 1:
                    pattern = pt.checker(self.frame(3, 14, turned=0.1))
                case 2:
                    pattern = pt.dots(self.frame(4, 16, turned=0.2), u(0.15, 0.4))
                case 3:
                    frame, seed = self.frame(2, 9), self.seed()
                    pattern = pt.blotches(frame, u(-0.3, 0.5), u(0.02, 0.4), gain=u(0.35, 0.65), seed=seed)
                case 4:
                    axis = np.eye(3)[1 if self.chance(0.7) else int(rng.choice([0, 2]))] * rng.choice([-1, 1])
                    at = float(box.mean(0) @ axis) + u(-0.3, 0.3) * size
                    soft = u(0.002, 0.01) if self.chance(0.5) else u(0.05, 0.4)
                    pattern = pt.ramp(tuple(axis.tolist()), at - soft, at + soft, 0.0, 0)
                case 5:
                    pattern = pt.mosaic(self.frame(4, 14), self.seed(), border=u(0.05, 0.2))
                case _:
                    pattern = pt.mosaic(self.frame(4, 16), self.seed(), fraction=u(0.1, 0.6))
            layers.append((second, pattern))
        return layers + self.label(box) if self.chance(0.8 * chance) else layers

    def label(self, box: np.ndarray) -> list[Layer]:
        """Label with rows of glyph-like blocks or a symmetric sign, with or without a background."""
        u, rng = self.u, self.rng
        extent, axis = box[1] - box[0], int(rng.choice([2, 0, 1], p=[0.6, 0.25, 0.15]))
        normal = np.eye(3)[axis] * rng.choice([1, 1, -1])
        up = np.eye(3)[1] if axis != 1 else np.eye(3)[2]
        right = np.cross(up, normal)
        half = 0.5 * np.abs([extent @ right, extent @ up]) * u(0.25, 0.85, 2)
        center = box.mean(0) + right * u(-0.3, 0.3) * (np.abs(extent @ right) / 2 - half[0])
        center = center + up * u(-0.6, 0.6) * (np.abs(extent @ up) / 2 - half[1])
        place = np.stack([center, right, up])
        paper = Coat(self.color(self.pick("white vivid any")), u(0.3, 0.8))
        plain = "dark" if sum(paper.color) > 1.0 else "white"
        ink = Coat(self.color(plain if self.chance(0.6) else "vivid"), paper.roughness)
        layers: list[Layer] = []
        oval = self.chance(0.2)
        if self.chance(0.75):
            layers.append((paper, pt.decal(place, half, np.ones((1, 1)), oval)))
        if self.chance(0.3):
            side = rng.random((9, 5)) < 0.55
            bitmap = np.concatenate([side, side[:, -2::-1]], 1)
            inner = np.full(2, 0.7 * half.min())
        else:
            bitmap, inner = self.text(int(rng.integers(1, 6)), int(rng.integers(3, 10))), half * 0.85
        return [*layers, (ink, pt.decal(place, inner, bitmap))]

    def text(self, rows: int, columns: int) -> np.ndarray:
        """Bitmap of rows of random glyphs of 5 by 3 blocks, each with a stem, which resemble print."""
        page = np.zeros((6 * rows + 1, 4 * columns + 1), dtype=bool)
        for i in range(rows):
            for j in range(columns if self.chance(0.5) else int(self.rng.integers(1, columns + 1))):
                glyph = self.rng.random((5, 3)) < 0.5
                glyph[:, 0 if self.chance(0.7) else 1] = True
                page[6 * i + 1 : 6 * i + 6, 4 * j + 1 : 4 * j + 4] = glyph
        return page

    def dirt(self, base: Coat) -> Layer:
        rgb = self.near((0.1, 0.075, 0.05), 0.4) if self.chance(0.6) else self.near(base.color, 0.5)
        dirt = Coat(rgb, float(np.clip(base.roughness + self.u(0, 0.3), 0.1, 1)))
        if self.chance(0.5):
            return dirt, pt.ramp((0.0, -1.0, 0.0), self.u(0.1, 0.4), self.u(0.5, 0.8), 0.3, self.seed())
        return dirt, self.blotches(self.frame(2, 7), (0.35, 0.9), (0.2, 0.5))

    def wear(self) -> Layer:
        """Scratched or flaking paint that exposes the material below."""
        below = Coat(self.color(self.pick("wood gray earth")), self.u(0.5, 0.95))
        if self.chance(0.35):
            scratch = self.frame(4, 10, stretch=6.0, turned=0.7)
            seed = self.seed()
            return below, pt.blotches(scratch, self.u(0.4, 0.48), 0.03, ridged=True, octaves=2, seed=seed)
        return below, self.blotches(self.frame(3, 9), (0.4, 1.0), (0.02, 0.15), octaves=5, gain=0.6)

    def wood(self, box: np.ndarray) -> Material:
        u, rgb = self.u, self.color("wood")
        longest = int(np.argmax(box[1] - box[0])) if self.chance(0.8) else int(self.rng.integers(3))
        axes = np.roll(np.eye(3), longest + 1, axis=1)  # the third pattern axis runs along the longest side
        frame = u(1.5, 4.0) * axes
        grain = pt.grain(frame, self.seed(), u(3, 9), tuple(u(0.5, 4.0, 2).tolist()))
        varnish = self.roughness(0.25, 0.85)
        late = _rgb(np.array(rgb) * u(0.3, 0.75) ** np.array([0.85, 1.0, 1.15]))
        layers: list[Layer] = [(Coat(late, min(varnish + 0.08, 1.0)), grain)]
        base = Coat(rgb, varnish)
        if self.chance(0.2):
            layers += self.decor(base, box, 0.4)
        if self.chance(0.3):
            layers.append(self.dirt(base))
        fiber = frame * np.array([12.0, 12.0, 0.7])[:, None]
        bumps = (self.bump(fiber, 0.02, 0.15),) if self.chance(0.6) else ()
        return Material(base, tuple(layers), bumps, u(0.03, 0.2), u(0, 0.08), u(2, 6), self.seed())

    def metal(self, box: np.ndarray) -> Material:
        u, rng = self.u, self.rng
        rgb = self.near(METALS[int(rng.choice(len(METALS), p=METAL_WEIGHTS))], 0.08)
        base = Coat(rgb, self.roughness(0.15, 0.6), 1.0)
        layers: list[Layer] = []
        bumps: list[SurfaceFunction] = []
        kind = rng.random()
        if kind < 0.25:  # rust or verdigris
            rust = self.near((0.22, 0.075, 0.03) if self.chance(0.75) else (0.16, 0.3, 0.24), 0.3)
            coat = Coat(rust, u(0.75, 1.0), 0.0)
            layers.append((coat, self.blotches(self.frame(2, 7), (-0.4, 0.8), (0.05, 0.35), octaves=5, gain=0.6)))
            bumps.append(self.noise(12, 40, u(0.02, 0.12)))
        elif kind < 0.5:  # brushed: long noise across one axis
            frame = self.frame(60, 120, stretch=30.0, turned=0.05)
            bumps.append(self.bump(frame, 0.05, 0.16))
            coat = Coat(self.near(rgb, 0.15), min(base.roughness + 0.1, 1.0), 1.0)
            layers.append((coat, pt.blotches(frame, 0.1, 0.5, seed=self.seed(), octaves=1)))
        elif kind < 0.65:  # hammered or cast
            bumps.append(self.noise(6, 20, u(0.05, 0.18)))
        elif kind < 0.85:  # painted, worn to the metal
            coat = Coat(self.color("any"), u(0.25, 0.8), 0.0)
            layers.append((coat, self.blotches(self.frame(2, 8), (-0.9, 0.0), (0.02, 0.1), octaves=5, gain=0.55)))
            if self.chance(0.4):
                layers += self.label(box)
        if self.chance(0.25):
            layers.append(self.dirt(base))
        return Material(base, tuple(layers), tuple(bumps), u(0, 0.06), u(0, 0.1), u(2, 8), self.seed())

    def stone(self) -> Material:
        u = self.u
        base = Coat(self.color(self.pick("gray white earth dark muted")), self.roughness(0.3, 0.95))
        other = Coat(self.near(base.color, 0.7) if self.chance(0.7) else self.color("any"), base.roughness)
        kind = self.rng.random()
        if kind < 0.45:
            frame = self.frame(1.5, 5, stretch=u(1, 3), turned=1.0)
            spots = self.blotches(frame, (0.0, 0.35), (0.05, 0.3), octaves=5, ridged=True)
        elif kind < 0.75:
            spots = self.blotches(self.frame(4, 20), (-0.2, 0.4), (0.1, 0.5), octaves=5, gain=0.65)
        else:
            spots = pt.mosaic(self.frame(10, 30), self.seed(), fraction=u(0.2, 0.5))
        layers: list[Layer] = [(other, spots)]
        bumps = (self.noise(8, 30, u(0.02, 0.16)),) if self.chance(0.6) else ()
        if self.chance(0.3):
            moss = Coat(self.near((0.12, 0.16, 0.05), 0.4), 0.95)
            layers.append((moss, pt.facing((0, 1, 0), 0.3, 0.9, self.seed())))
        return Material(base, tuple(layers), bumps, u(0.03, 0.2), u(0, 0.08), u(2, 8), self.seed())
