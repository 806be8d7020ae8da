"""Autocast, a default dtype, a default device and inference mode that the caller has set change no result."""

import contextlib
import functools
import math

import pytest
import torch
from torch import Tensor

import reli3d
from reli3d.cli.infer import EXAMPLE
from reli3d.geometry import distance, hull, mesh, symmetry, visibility
from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.io.hdr import write_environment
from reli3d.io.images import read_image
from reli3d.io.obj import obj_files
from reli3d.render import allocation, color, lights, material, sampling, transfer
from reli3d.render.environment import Environment
from reli3d.render.image import render_asset
from reli3d.render.shading import ShadeOptions
from tests.support import op_cases
from tests.support.op_cases import CASES, HOST, Case, numbers, units

ROWS = 40


@contextlib.contextmanager
def changed():
    """Autocast, float64 and ``meta``, which represents any device whose memory a CPU cannot read."""
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    try:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            yield
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)


def same(one, other) -> bool:
    if isinstance(one, Tensor):
        return (
            one.dtype == other.dtype
            and one.device == other.device
            and bool(torch.equal(torch.nan_to_num(one), torch.nan_to_num(other)))
        )
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if hasattr(one, "__dict__") and type(one).__module__.startswith("reli3d"):
        a, b = ({k: v for k, v in vars(x).items() if not k.startswith("_")} for x in (one, other))  # without caches
        return same(a, b)
    return one == other


@pytest.mark.parametrize("name", CASES)
def test_the_table_of_operations(name):
    case: Case = CASES[name]
    values = case.inputs(ROWS)

    def run():
        leaves = {k: v.clone().requires_grad_(k in case.grads) for k, v in values.items()}
        return leaves, case.run(**leaves)

    def gradients(leaves, outs):
        outs = [out for out in outs if out.requires_grad]
        ones = [torch.ones_like(out) for out in outs]
        return torch.autograd.grad(outs, [leaves[k] for k in case.grads], ones) if outs else ()

    leaves, plain = run()
    expected = [g.detach() for g in gradients(leaves, plain)]
    with changed():
        leaves, got = run()
        with torch.autocast("cpu", enabled=False):  # a backward pass belongs outside, by torch's documentation
            found = gradients(leaves, got)
    assert same(list(plain), list(got))
    assert same(expected, [g.detach() for g in found])


def floats(*values) -> Tensor:
    return torch.tensor(values, **HOST)


def ball(radius: float = 0.5) -> reli3d.Mesh:
    axis = torch.linspace(-1.0, 1.0, 13, **HOST)
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    return reli3d.extract_surface((x.square() + y.square() + z.square()).sqrt() - radius, radius=1.0)


def camera(count: int | None = None) -> Camera:
    turn = [k * 2.0 * math.pi / (count or 1) for k in range(count or 1)]
    poses = torch.stack([look_at([2.5 * math.sin(a), 0.6, 2.5 * math.cos(a)]) for a in turn])
    return Camera.from_fov(poses if count else poses[0], 0.6, 24, 24)


def asset() -> reli3d.Asset:
    unwrapped = reli3d.unwrap(ball(), texture_size=64).with_tangents()
    maps = reli3d.bake(unwrapped, 64, lambda position, normal: 0.5 + 0.4 * normal)
    return reli3d.Asset(unwrapped, reli3d.TextureSet(maps["value"], 0.5, 0.1), lights.LIGHTS["sky"](16))


def reconstructed():
    options = reli3d.ReconstructOptions(resolution=16, texture_size=256)
    return reli3d.reconstruct(reli3d.load_views(EXAMPLE).select(2), options=options)


def refined():
    return reli3d.refine(asset(), reli3d.load_views(EXAMPLE).select(2), steps=1, resolution=32)


def glb(folder):
    reli3d.write_glb(folder / "ball.glb", asset())
    return reli3d.read_glb(folder / "ball.glb"), (folder / "ball.glb").read_bytes()


def maps(folder):
    for name in ("map.hdr", "map.exr"):
        write_environment(folder / name, Environment(torch.rand(8, 16, 3, generator=op_cases.rng(1), **HOST)))
    return [reli3d.read_environment(folder / name) for name in ("map.hdr", "map.exr")]


def image(folder):
    reli3d.write_image(folder / "image.png", torch.rand(8, 9, 3, generator=op_cases.rng(1), **HOST))
    return read_image(folder / "image.png")


def mirrored():
    rig = camera(6)
    shape = ball()
    scene = reli3d.RayScene(shape.vertices * floats(1.0, 0.8, 0.5), shape.faces)
    masks = scene.closest(*camera_rays(rig)).valid.float()
    found = symmetry.mirror_plane(hull.mask_distance(masks), rig)
    return masks, found, symmetry.upright(rig), symmetry.MirrorPlane(floats(1.0, 0.0, 0.0), 0.1).mirrored(rig)


def meshes():
    shape = ball().with_normals()
    report = mesh.report(shape)
    return (
        report,
        mesh.largest_components(shape),
        mesh.watertight(shape),
        reli3d.unwrap(shape, texture_size=64).with_tangents().tangents,
    )


def draws():
    normal = units(ROWS, 1)
    return (
        sampling.halton(ROWS),
        material.sample_bsdf(normal, numbers(ROWS)[:, 0].contiguous(), numbers(ROWS), lobe="mirrored"),
        transfer.light_harmonics(lights.LIGHTS["studio"](16)),
        transfer.blocked_transfer(ball().with_normals(), directions=16),
        transfer.sphere_spiral(9),
        color.agx(numbers(ROWS).repeat(1, 2)[:, :3]),
    )


def planned():
    shown = asset()
    scene = reli3d.RayScene(shown.mesh.vertices, shown.mesh.faces)
    points, wo = op_cases.on_ball(units(ROWS, 1), units(ROWS, 1), 0.2 + 0.5 * units(ROWS).abs(), numbers(ROWS)[:, 0],
                                  numbers(ROWS)[:, 1])  # fmt: skip
    return allocation.plan_samples(points, wo, shown.environment, scene=scene, options=ShadeOptions(seed=1))


OPERATIONS = {
    "unwrap": lambda folder: reli3d.unwrap(ball(), texture_size=64),
    "render": lambda folder: render_asset([asset()], camera(), lights.LIGHTS["studio"](16)),
    "reconstruct": lambda folder: reconstructed(),
    "refine": lambda folder: refined(),
    "glb": glb,
    "obj": lambda folder: obj_files(asset(), "ball"),
    "environment files": maps,
    "image files": image,
    "load_views": lambda folder: reli3d.load_views(EXAMPLE),
    "symmetry": lambda folder: mirrored(),
    "meshes": lambda folder: meshes(),
    "rotated": lambda folder: lights.LIGHTS["sky"](16).rotated(0.7),
    "signed_distance": lambda folder: distance.signed_distance(ball().vertices, ball().faces, units(ROWS)),
    "visible_from": lambda folder: visibility.visible_from(
        reli3d.RayScene(ball().vertices, ball().faces), ball().vertices, ball().with_normals().normals, camera(3)
    ),
    "draws, harmonics": lambda folder: draws(),
    "plan_samples": lambda folder: planned(),
}


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory):
    """The results without such a state, by name."""
    return functools.cache(lambda name: OPERATIONS[name](tmp_path_factory.mktemp("unchanged")))


@pytest.mark.parametrize("state", [changed, torch.inference_mode])
@pytest.mark.parametrize("name", OPERATIONS)
def test_functions_built_on_operations(name, state, tmp_path, unchanged):
    expected = unchanged(name)
    with state():
        got = OPERATIONS[name](tmp_path)
    assert same(expected, got)
