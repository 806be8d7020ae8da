"""Our material formula as a Mitsuba one: images and variances are compared of one integrand."""

from __future__ import annotations

import numpy as np

from reli3d.render.asset import TextureSet


def material(mi, base_color, alpha, metallic, diffuse_model="conserving", maps: TextureSet | None = None):
    """A Mitsuba BSDF that evaluates the metallic-roughness formula; sampled by cosine and visible normals.

    maps: in place of the numbers, looked up by Mitsuba's own ``bitmap``.
    """
    import drjit as dr

    numbers = mi.Color3f(*base_color), mi.Float(alpha), mi.Float(metallic)
    dr.make_opaque(*numbers)  # not literals: one compiled kernel for all materials
    if maps is not None:
        planes = maps.base_color, maps.roughness[..., None], maps.metallic[..., None]
        bitmaps = [mi.Bitmap(np.ascontiguousarray(v.cpu().numpy(), np.float32)) for v in planes]
        textures = [mi.load_dict({"type": "bitmap", "bitmap": b, "raw": True}) for b in bitmaps]

    def values(si, active):
        """Base color, GGX width and metallic."""
        if maps is None:
            return numbers
        return textures[0].eval(si, active), textures[1].eval_1(si, active) ** 2, textures[2].eval_1(si, active)

    class MetallicRoughness(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components = [flags]
            self.m_flags = flags

        def sample(self, ctx, si, sample1, sample2, active):
            with dr.suspend_grad():  # samples and densities are constants; the value has the gradient
                bs = self.draw(ctx, si, sample1, sample2, active)
            return bs, dr.select(bs.pdf > 0, self.eval(ctx, si, bs.wo, active) / bs.pdf, 0)

        def draw(self, ctx, si, sample1, sample2, active):
            _, alpha, _ = values(si, active)
            distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, alpha)
            h, _ = distribution.sample(si.wi, sample2)
            cosine = mi.warp.square_to_cosine_hemisphere(sample2)
            bs = mi.BSDFSample3f()
            bs.wo = dr.select(sample1 < 0.5, cosine, mi.reflect(si.wi, h))
            bs.pdf = self.pdf(ctx, si, bs.wo, active)
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = mi.UInt32(0)
            return bs

        def eval(self, ctx, si, wo, active):
            i, o = si.wi, wo
            base, alpha, metallic = values(si, active)
            distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, alpha)
            h = dr.normalize(i + o)
            d = distribution.eval(h)  # Mitsuba's own density and masking; G2 from the two G1 is height-correlated Smith
            g = 1.0 / (dr.rcp(distribution.smith_g1(i, h)) + dr.rcp(distribution.smith_g1(o, h)) - 1.0)
            f0 = 0.04 * (1 - metallic) + base * metallic
            schlick = lambda cos: f0 + (1 - f0) * (1 - cos) ** 5
            f = schlick(dr.dot(i, h))
            left = 1 - f
            if diffuse_model == "conserving":
                left_i, left_o = (0.96 * (1 - (1 - (z + alpha) / (1 + alpha)) ** 5) for z in (i.z, o.z))
                left = left_i * left_o
            value = left * base * (1 - metallic) / dr.pi + f * d * g / (4 * i.z * o.z)
            return dr.select((i.z > 0) & (o.z > 0), value * o.z, 0)

        def pdf(self, ctx, si, wo, active):
            alpha = dr.detach(values(si, active)[1])
            distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, alpha)
            h = dr.normalize(si.wi + wo)
            lobe = distribution.pdf(si.wi, h) / (4 * dr.dot(si.wi, h))
            both = 0.5 * mi.warp.square_to_cosine_hemisphere_pdf(wo) + 0.5 * lobe
            return dr.select((si.wi.z > 0) & (wo.z > 0), both, 0)

        def eval_pdf(self, ctx, si, wo, active):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return "MetallicRoughness[]"

    mi.register_bsdf("reli3d_metallic_roughness", lambda props: MetallicRoughness(props))
    return {"type": "reli3d_metallic_roughness"}
