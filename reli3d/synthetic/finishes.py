"""Random materials for the parts of a procedural object, by their roles.

Palettes follow everyday objects: mostly grays, browns, whites and dark plastics, few saturated colors.  Colors are
linear Rec. 709.
"""

from collections.abc import Sequence

import numpy as np

from reli3d.synthetic import patterns as pt
from reli3d.synthetic.materials import Bump, Coat, Layer, Material

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
    metal = rng.random() < METAL_PROBABILITY
    takes = [metal and role == "metal" for role in roles]
    if metal and not any(takes):
        takes[int(rng.integers(len(roles)))] = rng.random() < 0.7
    shared: dict[str, Material] = {}
    result = []
    for role, is_metal, box in zip(roles, takes, bounds):
        kind = "metal" if is_metal else ("plastic" if role == "metal" else role)
        if not is_metal and rng.random() < 0.12:
            kind = str(rng.choice(["wood", "plastic", "paint", "fabric", "ceramic", "stone", "accent"]))
        if kind not in shared or rng.random() < 0.25:
            shared[kind] = _draw(rng, kind, box)
        result.append(shared[kind])
    return tuple(result)


def color(rng: np.random.Generator, kind: str) -> tuple[float, float, float]:
    """Random linear base color of a palette: ``gray white dark wood muted vivid earth any``."""
    u = rng.uniform
    if kind == "any":
        kind = str(
            rng.choice(
                ["gray", "white", "dark", "wood", "muted", "vivid", "earth"], p=[0.17, 0.17, 0.15, 0.1, 0.2, 0.1, 0.11]
            )
        )
    match kind:
        case "gray":
            rgb = np.exp(u(np.log(0.04), np.log(0.6))) * np.exp(rng.normal(0, 0.05, 3))
        case "white":
            rgb = u(0.55, 0.88) * np.array([1.0, 1.0 - u(0, 0.06), 1.0 - u(0, 0.2)])
        case "dark":
            rgb = u(0.02, 0.06) * np.exp(rng.normal(0, 0.12, 3))
        case "wood":
            rgb = (
                np.array(WOODS[int(rng.integers(len(WOODS)))])
                * np.exp(rng.normal(0, 0.2))
                * np.exp(rng.normal(0, 0.06, 3))
            )
        case "earth":
            rgb = _linear_of_hsv(u(0.02, 0.17), u(0.25, 0.75), u(0.2, 0.8))
        case "muted":
            rgb = _linear_of_hsv(u(), u(0.08, 0.42), u(0.25, 0.88))
        case _:
            rgb = _linear_of_hsv(u(), u(0.6, 0.97), u(0.35, 0.95))
    return _rgb(rgb)


def _rgb(values: np.ndarray) -> tuple[float, float, float]:
    red, green, blue = (float(x) for x in np.clip(values, 0.02, 0.88))
    return red, green, blue


def _linear_of_hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    ramp = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return (value * (1 - saturation + saturation * ramp)) ** 2.2  # the display curve, near enough for a random color


def _frame(
    rng: np.random.Generator, low: float, high: float, *, stretch: float = 1.0, turned: float = 0.2
) -> np.ndarray:
    """Random frame of ``low`` to ``high`` cycles per unit, permuted or, with probability ``turned``, rotated."""
    axes = np.eye(3)[rng.permutation(3)]
    if rng.random() < turned:
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    cycles = np.exp(rng.uniform(np.log(low), np.log(high)))
    return np.ascontiguousarray((cycles * np.array([1.0, 1.0, 1.0 / stretch]))[:, None] * axes)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 20))


def _near(rng: np.random.Generator, rgb: tuple, spread: float) -> tuple[float, float, float]:
    return _rgb(np.array(rgb) * np.exp(rng.normal(0, spread)) * np.exp(rng.normal(0, 0.2 * spread, 3)))


def _roughness(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(0.08, 0.2) if rng.random() < 0.06 else rng.uniform(low, high))


def _draw(rng: np.random.Generator, role: str, box: np.ndarray) -> Material:
    u = rng.uniform
    layers: list[Layer] = []
    bumps: list[Bump] = []
    match role:
        case "wood":
            return _wood(rng, box)
        case "metal":
            return _metal(rng, box)
        case "fabric":
            base = Coat(color(rng, "any"), u(0.7, 1.0))
            if rng.random() < 0.6:
                thread = _frame(rng, 20, 70, turned=0.1)
                layers.append((Coat(_near(rng, base.color, 0.35), base.roughness), pt.Weave(thread)))
                bumps.append(pt.Weave(thread, float(u(0.1, 0.35) / np.linalg.norm(thread[0]))))
            else:
                bumps.append(_noise_bump(rng, 15, 50, u(0.04, 0.15)))
        case "leather":
            base = Coat(
                color(rng, str(rng.choice(["wood", "dark", "earth", "vivid", "white"], p=[0.35, 0.3, 0.2, 0.1, 0.05]))),
                u(0.3, 0.7),
            )
            skin = _frame(rng, 18, 50)
            creases = Coat(_near(rng, base.color, 0.3), min(base.roughness + 0.15, 1.0))
            seed = _seed(rng)
            layers.append((creases, pt.Mosaic(skin, seed, border=0.12)))
            bumps.append(pt.Emboss(skin, seed, float(u(0.15, 0.4) / np.linalg.norm(skin[0])), cellular=True))
        case "ceramic":
            base = Coat(color(rng, "white" if rng.random() < 0.4 else "any"), _roughness(rng, 0.12, 0.5))
        case "stone":
            return _stone(rng)
        case "skin":
            base = Coat(color(rng, str(rng.choice(["earth", "wood", "gray", "white", "muted", "vivid"]))), u(0.45, 0.9))
            if rng.random() < 0.5:
                frame = _frame(rng, 3, 12)
                spots = (
                    pt.Mosaic(frame, _seed(rng), fraction=u(0.2, 0.6))
                    if rng.random() < 0.4
                    else pt.Blotches(frame, _seed(rng), u(-0.2, 0.4), u(0.03, 0.2))
                )
                layers.append((Coat(color(rng, "any"), base.roughness), spots))
            if rng.random() < 0.4:
                layers.append(
                    (
                        Coat(color(rng, "white" if rng.random() < 0.5 else "earth"), base.roughness),
                        pt.Facing((0, -1, 0), -0.2, 0.5, _seed(rng)),
                    )
                )
            if rng.random() < 0.5:
                bumps.append(_noise_bump(rng, 10, 40, u(0.02, 0.12)))
        case "rubber":
            base = Coat(color(rng, "dark" if rng.random() < 0.8 else "any"), u(0.45, 0.95))
        case "plastic":
            base = Coat(color(rng, "any" if rng.random() < 0.7 else "dark"), _roughness(rng, 0.2, 0.65))
            if rng.random() < 0.25:
                bumps.append(_noise_bump(rng, 40, 80, u(0.03, 0.1)))
        case _:  # paint, accent, any
            base = Coat(
                color(rng, "vivid" if role == "accent" and rng.random() < 0.5 else "any"), _roughness(rng, 0.2, 0.85)
            )
            if rng.random() < 0.22:
                layers += _wear(rng, base)
    layers[:0] = _decor(rng, base, box, 0.42 if role in ("paint", "ceramic", "any") else 0.25)
    if rng.random() < 0.2:
        layers.append(_dirt(rng, base))
    return Material(base, tuple(layers), tuple(bumps), u(0, 0.12), u(0, 0.06), u(2, 8), _seed(rng))


def _decor(rng: np.random.Generator, base: Coat, box: np.ndarray, chance: float) -> list:
    """Decoration in a second color: bands, checks, dots, blotches, a gradient along an axis, cells, labels."""
    u = rng.uniform
    layers: list[Layer] = []
    second = Coat(color(rng, "any"), float(np.clip(base.roughness + rng.normal(0, 0.1), 0.1, 1)))
    size = float(np.max(box[1] - box[0]))
    if rng.random() < chance:
        center = box.mean(0)
        match int(rng.choice(7, p=[0.25, 0.08, 0.1, 0.17, 0.2, 0.1, 0.1])):
            case 0:
                frame = _frame(rng, min(1.5 / size, 10), 14, turned=0.15)
                if rng.random() < 0.5:
                    frame = frame[[int(np.argmax(np.abs(frame[:, 1]))), 0, 1]]  # horizontal bands
                layers.append(
                    (second, pt.Bands(frame, u(0.15, 0.7), u(), u(0, 0.5) * (rng.random() < 0.25), _seed(rng)))
                )
            case 1:
                layers.append((second, pt.Checker(_frame(rng, 3, 14, turned=0.1))))
            case 2:
                layers.append((second, pt.Dots(_frame(rng, 4, 16, turned=0.2), u(0.15, 0.4))))
            case 3:
                layers.append(
                    (second, pt.Blotches(_frame(rng, 2, 9), _seed(rng), u(-0.3, 0.5), u(0.02, 0.4), gain=u(0.35, 0.65)))
                )
            case 4:
                axis = np.eye(3)[1 if rng.random() < 0.7 else int(rng.choice([0, 2]))] * rng.choice([-1, 1])
                at = float(center @ axis) + u(-0.3, 0.3) * size
                soft = u(0.002, 0.01) if rng.random() < 0.5 else u(0.05, 0.4)
                layers.append((second, pt.Ramp(tuple(axis.tolist()), at - soft, at + soft, 0.0, 0)))
            case 5:
                layers.append((second, pt.Mosaic(_frame(rng, 4, 14), _seed(rng), border=u(0.05, 0.2))))
            case _:
                layers.append((second, pt.Mosaic(_frame(rng, 4, 16), _seed(rng), fraction=u(0.1, 0.6))))
    if rng.random() < 0.8 * chance:
        layers += label(rng, box)
    return layers


def label(rng: np.random.Generator, box: np.ndarray) -> list:
    """Label with rows of glyph-like blocks or a symmetric sign, with or without a background."""
    u = rng.uniform
    extent, axis = box[1] - box[0], int(rng.choice([2, 0, 1], p=[0.6, 0.25, 0.15]))
    normal = np.eye(3)[axis] * rng.choice([1, 1, -1])
    up = np.eye(3)[1] if axis != 1 else np.eye(3)[2]
    right = np.cross(up, normal)
    half = 0.5 * np.abs([extent @ right, extent @ up]) * u(0.25, 0.85, 2)
    center = (
        box.mean(0)
        + right * u(-0.3, 0.3) * (np.abs(extent @ right) / 2 - half[0])
        + up * u(-0.6, 0.6) * (np.abs(extent @ up) / 2 - half[1])
    )
    place = [(float(x), float(y), float(z)) for x, y, z in (center, right, up)]
    paper = Coat(color(rng, str(rng.choice(["white", "vivid", "any"]))), u(0.3, 0.8))
    ink = Coat(
        color(rng, "dark" if sum(paper.color) > 1.0 else "white") if rng.random() < 0.6 else color(rng, "vivid"),
        paper.roughness,
    )
    layers: list[Layer] = []
    oval = rng.random() < 0.2
    if rng.random() < 0.75:
        layers.append((paper, _decal(place, half, np.ones((1, 1)), oval)))
    if rng.random() < 0.3:
        side = rng.random((9, 5)) < 0.55
        bitmap = np.concatenate([side, side[:, -2::-1]], 1)
        inner = np.full(2, 0.7 * half.min())
    else:
        bitmap, inner = _text(rng, int(rng.integers(1, 6)), int(rng.integers(3, 10))), half * 0.85
    layers.append((ink, _decal(place, inner, bitmap)))
    return layers


def _decal(place: list[tuple[float, float, float]], half: np.ndarray, bitmap: np.ndarray, oval=False) -> pt.Decal:
    center, right, up = place
    return pt.Decal(center, right, up, (float(half[0]), float(half[1])), bitmap.astype(np.float32), oval)


def _text(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    """Bitmap of rows of random glyphs of 5 by 3 blocks, each with a stem, which resemble print."""
    page = np.zeros((6 * rows + 1, 4 * columns + 1), dtype=bool)
    for i in range(rows):
        for j in range(columns if rng.random() < 0.5 else int(rng.integers(1, columns + 1))):
            glyph = rng.random((5, 3)) < 0.5
            glyph[:, 0 if rng.random() < 0.7 else 1] = True
            page[6 * i + 1 : 6 * i + 6, 4 * j + 1 : 4 * j + 4] = glyph
    return page


def _dirt(rng: np.random.Generator, base: Coat) -> tuple:
    dirt = Coat(
        _near(rng, (0.1, 0.075, 0.05), 0.4) if rng.random() < 0.6 else _near(rng, base.color, 0.5),
        float(np.clip(base.roughness + rng.uniform(0, 0.3), 0.1, 1)),
    )
    if rng.random() < 0.5:
        return dirt, pt.Ramp((0.0, -1.0, 0.0), rng.uniform(0.1, 0.4), rng.uniform(0.5, 0.8), 0.3, _seed(rng))
    return dirt, pt.Blotches(_frame(rng, 2, 7), _seed(rng), rng.uniform(0.35, 0.9), rng.uniform(0.2, 0.5))


def _wear(rng: np.random.Generator, base: Coat) -> list:
    """Scratched or flaking paint that exposes the material below."""
    below = Coat(color(rng, str(rng.choice(["wood", "gray", "earth"]))), rng.uniform(0.5, 0.95))
    if rng.random() < 0.35:
        scratch = _frame(rng, 4, 10, stretch=6.0, turned=0.7)
        return [(below, pt.Blotches(scratch, _seed(rng), rng.uniform(0.4, 0.48), 0.03, octaves=2, ridged=True))]
    return [
        (
            below,
            pt.Blotches(
                _frame(rng, 3, 9), _seed(rng), rng.uniform(0.4, 1.0), rng.uniform(0.02, 0.15), octaves=5, gain=0.6
            ),
        )
    ]


def _noise_bump(rng: np.random.Generator, low: float, high: float, steepness: float) -> pt.Emboss:
    frame = _frame(rng, low, high)
    return pt.Emboss(frame, _seed(rng), steepness / float(np.linalg.norm(frame[0])), octaves=2)


def _wood(rng: np.random.Generator, box: np.ndarray) -> Material:
    u, rgb = rng.uniform, color(rng, "wood")
    longest = int(np.argmax(box[1] - box[0])) if rng.random() < 0.8 else int(rng.integers(3))
    axes = np.roll(np.eye(3), longest + 1, axis=1)  # the third pattern axis runs along the longest side
    frame = u(1.5, 4.0) * axes
    grain = pt.Grain(frame, _seed(rng), u(3, 9), tuple(u(0.5, 4.0, 2).tolist()))
    varnish = _roughness(rng, 0.25, 0.85)
    late = _rgb(np.array(rgb) * u(0.3, 0.75) ** np.array([0.85, 1.0, 1.15]))
    layers: list[Layer] = [(Coat(late, min(varnish + 0.08, 1.0)), grain)]
    base = Coat(rgb, varnish)
    if rng.random() < 0.2:
        layers += _decor(rng, base, box, 0.4)
    if rng.random() < 0.3:
        layers.append(_dirt(rng, base))
    fiber = frame * np.array([12.0, 12.0, 0.7])[:, None]
    bumps = (
        (pt.Emboss(fiber, _seed(rng), u(0.02, 0.15) / float(np.linalg.norm(fiber[0])), octaves=1),)
        if rng.random() < 0.6
        else ()
    )
    return Material(base, tuple(layers), bumps, u(0.03, 0.2), u(0, 0.08), u(2, 6), _seed(rng))


def _metal(rng: np.random.Generator, box: np.ndarray) -> Material:
    u = rng.uniform
    rgb = _near(rng, METALS[int(rng.choice(len(METALS), p=METAL_WEIGHTS))], 0.08)
    base = Coat(rgb, _roughness(rng, 0.15, 0.6), 1.0)
    layers: list[Layer] = []
    bumps: list[Bump] = []
    kind = rng.random()
    if kind < 0.25:  # rust or verdigris
        rust = Coat(
            _near(rng, (0.22, 0.075, 0.03) if rng.random() < 0.75 else (0.16, 0.3, 0.24), 0.3), u(0.75, 1.0), 0.0
        )
        layers.append(
            (rust, pt.Blotches(_frame(rng, 2, 7), _seed(rng), u(-0.4, 0.8), u(0.05, 0.35), octaves=5, gain=0.6))
        )
        bumps.append(_noise_bump(rng, 12, 40, u(0.02, 0.12)))
    elif kind < 0.5:  # brushed: long noise across one axis
        frame = _frame(rng, 60, 120, stretch=30.0, turned=0.05)
        bumps.append(pt.Emboss(frame, _seed(rng), u(0.05, 0.16) / float(np.linalg.norm(frame[0])), octaves=1))
        layers.append(
            (
                Coat(_near(rng, rgb, 0.15), min(base.roughness + 0.1, 1.0), 1.0),
                pt.Blotches(frame, _seed(rng), 0.1, 0.5, octaves=1),
            )
        )
    elif kind < 0.65:  # hammered or cast
        bumps.append(_noise_bump(rng, 6, 20, u(0.05, 0.18)))
    elif kind < 0.85:  # painted, worn to the metal
        paint = Coat(color(rng, "any"), u(0.25, 0.8), 0.0)
        layers.append(
            (paint, pt.Blotches(_frame(rng, 2, 8), _seed(rng), u(-0.9, 0.0), u(0.02, 0.1), octaves=5, gain=0.55))
        )
        if rng.random() < 0.4:
            layers += label(rng, box)
    if rng.random() < 0.25:
        layers.append(_dirt(rng, base))
    return Material(base, tuple(layers), tuple(bumps), u(0, 0.06), u(0, 0.1), u(2, 8), _seed(rng))


def _stone(rng: np.random.Generator) -> Material:
    u = rng.uniform
    base = Coat(color(rng, str(rng.choice(["gray", "white", "earth", "dark", "muted"]))), _roughness(rng, 0.3, 0.95))
    layers: list[Layer] = []
    bumps: list[Bump] = []
    other = Coat(_near(rng, base.color, 0.7) if rng.random() < 0.7 else color(rng, "any"), base.roughness)
    kind = rng.random()
    if kind < 0.45:
        layers.append(
            (
                other,
                pt.Blotches(
                    _frame(rng, 1.5, 5, stretch=u(1, 3), turned=1.0),
                    _seed(rng),
                    u(0.0, 0.35),
                    u(0.05, 0.3),
                    octaves=5,
                    ridged=True,
                ),
            )
        )
    elif kind < 0.75:
        layers.append(
            (other, pt.Blotches(_frame(rng, 4, 20), _seed(rng), u(-0.2, 0.4), u(0.1, 0.5), octaves=5, gain=0.65))
        )
    else:
        layers.append((other, pt.Mosaic(_frame(rng, 10, 30), _seed(rng), fraction=u(0.2, 0.5))))
    if rng.random() < 0.6:
        bumps.append(_noise_bump(rng, 8, 30, u(0.02, 0.16)))
    if rng.random() < 0.3:
        layers.append((Coat(_near(rng, (0.12, 0.16, 0.05), 0.4), 0.95), pt.Facing((0, 1, 0), 0.3, 0.9, _seed(rng))))
    return Material(base, tuple(layers), tuple(bumps), u(0.03, 0.2), u(0, 0.08), u(2, 8), _seed(rng))
