"""Embree by its C interface: packets of shadow rays against single rays, lifetime of trees, a wheel without Embree."""

import sys
import threading
import weakref

import numpy as np
import pytest
import torch

from reli3d.geometry import embree
from reli3d.geometry.rays import RayScene
from tests.support.rays import bumpy, make, rays


@pytest.mark.parametrize("count", [1, 15, 16, 17, 63, 64, 65, 1000, 60_000])
def test_packets_find_what_single_rays_find(device, count):
    """Any number, any limit, some switched off by -1, from several places or from one."""
    scene = make(*bumpy(3, subdivisions=4, height=0.5), "embree", device)
    o, d = rays(count, 4, 1.0)
    g = torch.Generator().manual_seed(count)
    limit = torch.rand(count, generator=g) * 2.0
    limit[torch.rand(count, generator=g) < 0.3] = -1.0
    limit[torch.rand(count, generator=g) < 0.3] = torch.inf
    for origins in (o, o[:1].expand(count, 3)):
        free = scene.unoccluded(origins, d, limit)
        single = (limit >= 0.0) & ~scene.occluded(origins, d, t_max=limit)
        # a ray through an edge may count for either face, or miss by rounding in one of the two
        assert int((free != single).sum()) <= 1e-4 * count
    assert count < 1000 or 0.1 < float(free.float().mean()) < 0.6


def test_packets_leave_no_closed_mesh(device):
    """Embree's own bound for rays that leak: 2e-5."""
    scene = make(*bumpy(2, subdivisions=4), "embree", device)
    o, d = rays(300_000, 5, 0.3)
    assert int(scene.unoccluded(o, d, torch.full((len(o),), torch.inf)).sum()) <= 2e-5 * len(o)


def test_scenes_in_many_threads_answer_as_alone_and_are_freed(device):
    if device.type != "cpu":
        pytest.skip("Embree runs on CPU only")
    o, d = rays(3000, 6, 1.5)
    meshes = [bumpy(seed) for seed in range(8)]
    expected = [make(*mesh, "embree", device).closest(o, d).face for mesh in meshes]
    failed = []

    def work(k):
        for _ in range(10):
            scene = RayScene(*(torch.from_numpy(a) for a in meshes[k]), backend="embree")
            if not torch.equal(scene.closest(o, d).face, expected[k]):
                failed.append(k)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    tree = embree.Tree(*meshes[0])
    held, freed = weakref.ref(tree), []
    weakref.finalize(tree, freed.append, tree.scene)
    del tree
    assert held() is None and len(freed) == 1


def test_embree_is_found_in_the_wheel_and_its_absence_is_reported(monkeypatch, tmp_path):
    """Where the extension does not export Embree's symbols, as on Windows, the bundled library is loaded."""
    import embreex
    from embreex import rtcore_scene

    other = np.linalg._umath_linalg.__file__  # a library of other names
    monkeypatch.setattr(rtcore_scene, "__file__", other)
    if sys.platform != "darwin":
        library, device = embree._embree.__wrapped__()
        assert library.rtcGetDeviceProperty(device, embree.VERSION) >= 40000
    monkeypatch.setattr(embreex, "__file__", str(tmp_path / "embreex" / "__init__.py"))
    with pytest.raises(ImportError, match="embreex: expected a wheel with Embree's library, found none"):
        embree._embree.__wrapped__()
