"""Reads GLB materials as texture sets; see ``gltf.py`` for the container."""

import io
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from reli3d._bridge import present
from reli3d.errors import InputError, shown
from reli3d.io.gltf import Document
from reli3d.render.asset import TextureSet
from reli3d.render.color import srgb_to_linear
from reli3d.render.gbuffer import sample_texture, wrap_uv

FORMATS = ("PNG", "JPEG", "WEBP")
MAX_SCALE = 1e6  # of a normal texture: beyond it, float32 loses the normal's z
UNIFORM_SIZE = 4  # texels per side of a texture without an image
MAX_SIDE = 4096  # texels along a side of textures that are resampled to one layout
WRAPS = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
NEAREST = (9728, 9984, 9986)  # filters that take the nearest texel
SPECULAR_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
DIELECTRIC = 0.04  # reflectance at normal incidence of core glTF's dielectrics


@dataclass(frozen=True)
class _Layout:
    """How a texture is addressed: set of texture coordinates, affine transform ``(2, 3)`` by rows, wrap modes."""

    channel: int
    transform: tuple[float, ...]
    wrap: tuple[str, str]

    def apply(self, uv: np.ndarray) -> np.ndarray:
        rows = np.array(self.transform).reshape(2, 3)
        with np.errstate(all="ignore"):  # the caller reports what overflows
            return uv if self.transform == _IDENTITY else uv @ rows[:, :2].T + rows[:, 2]


_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class _Slot:
    """A texture of a material: image ``(H, W, 4)`` in [0, 1], and its layout."""

    image: Tensor
    layout: _Layout


@dataclass(frozen=True)
class _Material:
    """Factors, and slots that are None where the material has no texture."""

    color: list[float]
    normal_scale: float
    slots: list[_Slot | None]  # color, parameters, normal
    roughness: float = 1.0
    metallic: float = 1.0
    specular: list[float] | None = None  # of the specular-glossiness workflow, with ``glossiness``
    glossiness: float = 1.0

    def decoded(self, slot: int) -> Tensor:
        """Image ``(H, W, 4)`` of a slot, colors decoded from sRGB, which glTF asks for before interpolation."""
        image = present("image", self.slots[slot]).image
        if slot == 0 or slot == 1 and self.specular is not None:
            return torch.cat([srgb_to_linear(image[..., :3]), image[..., 3:]], -1)
        return image


class Materials:
    """Texture sets of the materials of one document."""

    def __init__(self, document: Document, max_pixels: int):
        self.document, self.left, self.squares = document, max_pixels, max_pixels
        self.parsed: dict[object, _Material] = {}
        self.made: dict[object, TextureSet] = {}
        self.images: dict[object, Tensor] = {}

    def textures(
        self, index: object, field: str, coordinates: Callable[[int], np.ndarray | None]
    ) -> tuple[TextureSet, np.ndarray | None]:
        """Texture set of a material and its texture coordinates ``(N, 2)``, None without textures.

        coordinates: maps a set index to texture coordinates ``(N, 2)`` of the primitive, or None.
        """
        entry = {} if index is None else self.document.item("materials", index, field)
        if index not in self.parsed:
            self.parsed[index] = self._parse(entry, f"materials[{index}]")
        material = self.parsed[index]
        layouts = {slot.layout for slot in material.slots if slot is not None}
        channels = {layout.channel for layout in layouts}
        if len(channels) > 1:
            expected = "expected one UV channel for all textures"
            self.document.fail(f"materials[{index}]", expected, sorted(channels), "bake to one")
        uv = coordinates(next(iter(channels), 0))
        if not layouts:
            return self._kept(index, material), uv
        if len(layouts) == 1:
            self._kept(index, material)  # its errors come first
        if uv is None:
            name = f"TEXCOORD_{channels.pop()}"
            self.document.fail(f"{field[: -len('.material')]}.attributes", f"expected {name} for its texture", None)
        if len(layouts) == 1:
            return self._kept(index, material), layouts.pop().apply(uv)
        low, high = uv.min(0), uv.max(0)
        span = np.maximum(high - low, 1e-6)
        return self._resampled(material, low, span, f"materials[{index}]"), (uv - low) / span

    def _kept(self, index: object, material: _Material) -> TextureSet:
        if index not in self.made:
            slots = material.slots
            size = max((max(s.image.shape[:2]) for s in slots if s is not None), default=UNIFORM_SIZE)
            self._count(size, f"materials[{index}]")
            maps = [None if s is None else _square(material.decoded(k), size) for k, s in enumerate(slots)]
            wrap = next((s.layout.wrap for s in slots if s is not None), ("repeat", "repeat"))
            self.made[index] = self._make(material, maps, size, wrap)
        return self.made[index]

    def _resampled(self, material: _Material, low: np.ndarray, span: np.ndarray, field: str) -> TextureSet:
        """Textures of different layouts, looked up at the texel centers of the box ``low``, ``span`` of the uv."""
        with np.errstate(all="ignore"):  # overflow is an error below
            sides = [
                np.abs(np.array(s.layout.transform).reshape(2, 3)[:, :2] * span).sum(1) * s.image.shape[1::-1]
                for s in material.slots
                if s is not None
            ]
        largest = float(np.max(sides))
        if not largest <= MAX_SIDE:
            expected = f"expected transforms and wrap modes of its textures that fit one of {MAX_SIDE} texels"
            self.document.fail(field, expected, largest, "bake to one UV channel")
        size = max(UNIFORM_SIZE, math.ceil(largest))
        self._count(size, field)
        self.document.note(f"{field}: textures of different transforms or wrap modes are resampled to one layout")
        center = (np.arange(size) + 0.5) / size
        uv = np.stack(np.meshgrid(center, center), -1).reshape(-1, 2) * span + low

        def resampled(k: int, slot: _Slot) -> Tensor:
            image = material.decoded(k)
            height, width = image.shape[:2]
            at = np.array(slot.layout.apply(uv))
            for axis, mode in enumerate(slot.layout.wrap):  # within float32's precision
                at[:, axis] = np.clip(at[:, axis], -1.0, 2.0) if mode == "clamp" else at[:, axis] % 2.0
            place = wrap_uv(torch.from_numpy(at).float(), slot.layout.wrap, (width, height))
            color = sample_texture(image[..., :3].contiguous(), place)
            alpha = sample_texture(image[..., 3:].expand(-1, -1, 3).contiguous(), place)
            return torch.cat([color, alpha[:, :1]], 1).reshape(size, size, 4)

        maps = [None if s is None else resampled(k, s) for k, s in enumerate(material.slots)]
        return self._make(material, maps, size, ("clamp", "clamp"))

    def _count(self, size: int, field: str) -> None:
        if size > UNIFORM_SIZE:
            self.squares -= size * size
            if self.squares < 0:
                expected = "expected smaller textures: images are made square, for each material"
                self.document.fail(field, expected, size, "use smaller textures or fewer materials")

    def _make(self, material: _Material, maps: list[Tensor | None], size: int, wrap: tuple[str, str]) -> TextureSet:
        white = torch.ones(size, size, 4, dtype=torch.float32, device="cpu")
        color, parameters = (white if m is None else m for m in maps[:2])
        color = color[..., :3] * _factor(material.color).clamp(0.0, 1.0)
        if material.specular is None:
            rough = parameters[..., 1] * min(max(material.roughness, 0.0), 1.0)
            metal = parameters[..., 2] * min(max(material.metallic, 0.0), 1.0)
        else:
            specular = parameters[..., :3] * _factor(material.specular).clamp(0.0, 1.0)
            rough = 1.0 - parameters[..., 3] * min(max(material.glossiness, 0.0), 1.0)
            color, metal = metallic_from_specular(color, specular)
        normal = None if maps[2] is None else maps[2][..., :3]
        if normal is not None and material.normal_scale != 1.0:
            mapped = (normal * 2.0 - 1.0) * _factor([material.normal_scale, material.normal_scale, 1.0])
            normal = torch.nn.functional.normalize(mapped, dim=-1, eps=1e-6) * 0.5 + 0.5
        return TextureSet(color.clamp(0.0, 1.0), rough.contiguous(), metal.contiguous(), normal, wrap=wrap)

    def _parse(self, material: dict, field: str) -> _Material:
        get, numbers, leave_out = self.document.get, self.document.numbers, self.document.leave_out
        extensions = self.document.extensions(material, field)
        if get(material, "alphaMode", str, field, "OPAQUE") != "OPAQUE":
            leave_out("alpha")
        if any(numbers(material, "emissiveFactor", 3, field, [0, 0, 0])):
            leave_out("emission")
        if "occlusionTexture" in material:
            leave_out("occlusionTexture")
        normal = self._slot(material, "normalTexture", field)
        scale = 1.0
        if normal is not None:
            scale = get(material["normalTexture"], "scale", float, f"{field}.normalTexture", 1.0)
            if abs(scale) > MAX_SCALE:
                self.document.fail(f"{field}.normalTexture.scale", f"expected at most {MAX_SCALE:g}", scale)
        if SPECULAR_GLOSSINESS in extensions:
            self.document.note(f"{SPECULAR_GLOSSINESS} is converted to metallic and roughness")
            where = f"{field}.extensions.{SPECULAR_GLOSSINESS}"
            gloss = get(extensions, SPECULAR_GLOSSINESS, dict, f"{field}.extensions")
            names = "diffuseTexture", "specularGlossinessTexture"
            return _Material(
                numbers(gloss, "diffuseFactor", 4, where, [1, 1, 1, 1])[:3],
                scale,
                [*(self._slot(gloss, name, where) for name in names), normal],
                specular=numbers(gloss, "specularFactor", 3, where, [1, 1, 1]),
                glossiness=get(gloss, "glossinessFactor", float, where, 1.0),
            )
        where = f"{field}.pbrMetallicRoughness"
        pbr = get(material, "pbrMetallicRoughness", dict, field, {})
        return _Material(
            numbers(pbr, "baseColorFactor", 4, where, [1, 1, 1, 1])[:3],
            scale,
            [self._slot(pbr, "baseColorTexture", where), self._slot(pbr, "metallicRoughnessTexture", where), normal],
            get(pbr, "roughnessFactor", float, where, 1.0),
            get(pbr, "metallicFactor", float, where, 1.0),
        )

    def _slot(self, node: dict, key: str, place: str) -> _Slot | None:
        if key not in node:
            return None
        get, document, field = self.document.get, self.document, f"{place}.{key}"
        info = get(node, key, dict, place)
        channel = get(info, "texCoord", int, field, 0)
        transform = _IDENTITY
        extensions = document.extensions(info, field)
        if "KHR_texture_transform" in extensions:
            where = f"{field}.extensions.KHR_texture_transform"
            change = get(extensions, "KHR_texture_transform", dict, f"{field}.extensions")
            x, y = document.numbers(change, "offset", 2, where, [0, 0])
            sx, sy = document.numbers(change, "scale", 2, where, [1, 1])
            turn = get(change, "rotation", float, where, 0.0)
            c, s = math.cos(turn), math.sin(turn)
            transform = (c * sx, s * sy, x, -s * sx, c * sy, y)  # counter-clockwise as seen, where v is down
            channel = get(change, "texCoord", int, where, channel)
        texture = document.item("textures", info.get("index"), f"{field}.index")
        where = f"textures[{info['index']}]"
        fallbacks = ("KHR_texture_basisu", "MSFT_texture_dds", "EXT_texture_avif") if "source" in texture else ()
        webp = get(document.extensions(texture, where, *fallbacks), "EXT_texture_webp", dict, f"{where}.extensions", {})
        image = self._image(webp.get("source", texture.get("source")), f"{where}.source")
        sampler: dict = {}
        if "sampler" in texture:
            sampler = document.item("samplers", texture["sampler"], f"{where}.sampler")
        modes = [get(sampler, name, int, f"{where}.sampler", 10497) for name in ("wrapS", "wrapT")]
        for mode in modes:
            if mode not in WRAPS:
                document.fail(f"{where}.sampler", f"expected wrap modes {sorted(WRAPS)}", mode)
        if get(sampler, "magFilter", int, f"{where}.sampler", 0) in NEAREST:
            document.leave_out("filtering by the nearest texel")
        return _Slot(image, _Layout(channel, transform, (WRAPS[modes[0]], WRAPS[modes[1]])))

    def _image(self, index: object, field: str) -> Tensor:
        """``(H, W, 4)`` in [0, 1] as stored, alpha 1 where there is none."""
        entry = self.document.item("images", index, field)
        if index in self.images:
            return self.images[index]
        where = f"images[{index}]"
        if "bufferView" in entry:
            data = bytes(self.document.view(entry["bufferView"], f"{where}.bufferView")[0])
        else:
            data = self.document.data_uri(entry, where)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                    if not 0 < math.prod(image.size) <= self.left:
                        expected = f"expected at most {self.left} more pixels in all"
                        self.document.fail(where, expected, image.size, "use smaller textures")
                    self.left -= math.prod(image.size)
                    if image.mode.startswith("I"):  # 16 bit gray
                        gray = np.asarray(image).astype(np.float32)[..., None] / 65535.0
                        pixels = np.concatenate([np.repeat(gray, 3, -1), np.ones_like(gray)], -1)
                    else:
                        pixels = np.asarray(image.convert("RGBA")).astype(np.float32) / np.float32(255.0)
        except InputError:
            raise
        except Exception as error:  # on a broken file decoders raise almost anything: struct.error, IndexError ...
            got = shown(str(error))
            path, expected = self.document.path, "expected a PNG, JPEG or WebP image"
            raise InputError(path, f"{where}: {expected}, got {got}; save the image again") from None
        self.images[index] = torch.from_numpy(pixels)
        return self.images[index]


def metallic_from_specular(diffuse: Tensor, specular: Tensor) -> tuple[Tensor, Tensor]:
    """Base color ``(..., 3)`` and metallic ``(...)`` whose reflectances are closest to ``diffuse`` and ``specular``.

    diffuse, specular: ``(..., 3)``, linear.  Source: conversion example of Khronos'
    KHR_materials_pbrSpecularGlossiness.
    """
    weights = diffuse.new_tensor([0.299, 0.587, 0.114])
    d, s = ((v * v * weights).sum(-1).sqrt() for v in (diffuse, specular))  # perceived brightness
    left = 1.0 - specular.amax(-1)  # energy transmitted to the diffuse layer
    b = d * left / (1.0 - DIELECTRIC) + s - 2.0 * DIELECTRIC
    root = (b * b - 4.0 * DIELECTRIC * (DIELECTRIC - s)).clamp(min=0.0).sqrt()
    metallic = torch.where(s < DIELECTRIC, torch.zeros_like(s), ((root - b) / (2.0 * DIELECTRIC)).clamp(0.0, 1.0))
    m = metallic[..., None]
    from_diffuse = diffuse * left[..., None] / (1.0 - DIELECTRIC) / (1.0 - m).clamp(min=1e-6)
    from_specular = (specular - DIELECTRIC * (1.0 - m)) / m.clamp(min=1e-6)
    return torch.lerp(from_diffuse, from_specular, m * m).clamp(0.0, 1.0), metallic


def _square(image: Tensor, size: int) -> Tensor:
    """``(size, size, C)`` by bilinear interpolation, texel centers at +0.5."""
    if image.shape[:2] == (size, size):
        return image
    planes = image.permute(2, 0, 1)[None]
    resized = torch.nn.functional.interpolate(planes, (size, size), mode="bilinear", align_corners=False)
    return resized[0].permute(1, 2, 0).contiguous()


def _factor(values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float32, device="cpu")
