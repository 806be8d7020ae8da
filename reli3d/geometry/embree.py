"""Embree's BVH through its C interface, from the library in the embreex wheel.

embreex itself copies every ray in and out and has no packets.  This module builds the BVH; :mod:`reli3d.kernels.embree`
traces rays in it by the addresses of Embree's functions.  Names and constants: Embree 4 API reference,
https://github.com/RenderKit/embree.
"""

import ctypes
import weakref
from functools import lru_cache
from pathlib import Path

import numpy as np

VERSION = 0  # device property: 40400 is 4.4.0
TRIANGLES, ROBUST = 0, 1 << 2
INDEX, VERTEX = (0, 0x5003), (1, 0x9003)  # kind of buffer and format of its items: 3 unsigned, 3 float
POINTER, SIZE = ctypes.c_void_p, ctypes.c_size_t
SIGNATURES = {
    "rtcNewDevice": (POINTER, ctypes.c_char_p),
    "rtcGetDeviceError": (ctypes.c_int, POINTER),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, POINTER, ctypes.c_int),
    "rtcNewScene": (POINTER, POINTER),
    "rtcSetSceneFlags": (None, POINTER, ctypes.c_int),
    "rtcNewGeometry": (POINTER, POINTER, ctypes.c_int),
    "rtcSetNewGeometryBuffer": (POINTER, POINTER, ctypes.c_int, ctypes.c_uint, ctypes.c_int, SIZE, SIZE),
    "rtcCommitGeometry": (None, POINTER),
    "rtcAttachGeometry": (ctypes.c_uint, POINTER, POINTER),
    "rtcReleaseGeometry": (None, POINTER),
    "rtcCommitScene": (None, POINTER),
    "rtcReleaseScene": (None, POINTER),
}


@lru_cache(1)
def _embree() -> tuple[ctypes.CDLL, int]:
    """The library and its one device.  Raises ImportError where embreex comes without Embree 4."""
    import embreex
    from embreex import rtcore_scene

    bundled = sorted(Path(embreex.__file__).parents[1].glob("embreex.libs/*embree4*"))
    for path in (Path(rtcore_scene.__file__), *bundled):  # on some platforms the extension itself exports the symbols
        library = ctypes.CDLL(str(path))
        if hasattr(library, "rtcNewDevice"):
            break
    else:
        raise ImportError(f"embreex: expected a wheel with Embree's library, found none next to {embreex.__file__}")
    for name, (result, *arguments) in SIGNATURES.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    device = library.rtcNewDevice(None)
    version = library.rtcGetDeviceProperty(device, VERSION) if device else 0
    if version // 10000 != 4:
        raise ImportError(f"embreex: expected Embree 4, got version number {version}")
    return library, device


def query(name: str) -> int:
    """Address of ``rtcIntersect1``, ``rtcOccluded1`` or ``rtcOccluded16``, for a kernel.

    Packets also work on a processor without vectors of 16 floats: Embree then traces the rays one by one.
    """
    return ctypes.cast(getattr(_embree()[0], name), POINTER).value or 0


class Tree:
    """Embree scene of triangles in robust mode; ``scene``: its handle, valid while the object exists.

    vertices: ``(V, 3)`` float32.  faces: ``(F, 3)`` int32 in [0, V).  Raises RuntimeError if Embree cannot build the
    scene.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        library, device = _embree()
        self.scene = library.rtcNewScene(device)
        weakref.finalize(self, library.rtcReleaseScene, self.scene)
        library.rtcSetSceneFlags(self.scene, ROBUST)
        geometry = library.rtcNewGeometry(device, TRIANGLES)
        for (kind, form), items in ((VERTEX, vertices), (INDEX, faces)):
            items = np.ascontiguousarray(items)
            place = library.rtcSetNewGeometryBuffer(geometry, kind, 0, form, items.itemsize * 3, len(items))
            if place:
                ctypes.memmove(place, items.ctypes.data, items.nbytes)
        library.rtcCommitGeometry(geometry)
        library.rtcAttachGeometry(self.scene, geometry)
        library.rtcReleaseGeometry(geometry)
        library.rtcCommitScene(self.scene)
        error = library.rtcGetDeviceError(device)
        if error:
            raise RuntimeError(f"embree: expected a tree of {len(faces)} faces, got its error {error}")
