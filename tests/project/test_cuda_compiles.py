"""Every kernel is valid CUDA: Warp carries NVIDIA's compiler, which needs no device.  Running them does."""

import importlib
import pkgutil

import pytest
import warp as wp

from reli3d import kernels
from reli3d.kernels.cache import initialize

FOUND = [importlib.import_module(f"{kernels.__name__}.{info.name}") for info in pkgutil.iter_modules(kernels.__path__)]
MODULES = {module.__name__.rpartition(".")[2]: module for module in FOUND if wp.get_module(module.__name__).kernels}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_kernels_compile_for_cuda(tmp_path, name):
    initialize()
    module = wp.get_module(MODULES[name].__name__)
    wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    (text,) = (path.read_text() for path in tmp_path.glob("*.ptx"))
    assert ".target sm_90" in text
    for kernel in module.kernels.values():
        passes = ["forward", "backward"] if {**module.options, **kernel.options}["enable_backward"] else ["forward"]
        assert all(f"{kernel.get_mangled_name()}_cuda_kernel_{which}(" in text for which in passes), kernel.key
