"""Every kernel compiles for CUDA, on a machine that has none; and computes the same where there is one."""

import importlib
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
from tests.physics.test_invariance import room

PACKAGE = Path(ir.__file__).parent
KERNEL_MODULES = [
    importlib.import_module(".".join(("warp_ir", *path.relative_to(PACKAGE).with_suffix("").parts)))
    for path in sorted(PACKAGE.rglob("*.py"))
    if "@wp.kernel" in path.read_text()
]


@pytest.mark.parametrize("module", KERNEL_MODULES, ids=lambda m: m.__name__)
@pytest.mark.parametrize("arch", [pytest.param(75, marks=pytest.mark.slow), 90])
def test_kernels_compile_for_cuda(module, arch, tmp_path):
    """Turing and Hopper machine code comes out of every module."""
    wp.compile_aot_module(module, arch=arch, module_dir=tmp_path, use_ptx=False)
    assert [p.stat().st_size > 0 for p in tmp_path.glob("*.cubin")] == [True]


@pytest.mark.gpu
@pytest.mark.parametrize("estimator", ["vpl", "keller", "path"])
def test_cuda_agrees_with_cpu(estimator):
    """The same picture up to rounding: the samples are the same numbers; a ray at an edge may fall the other way."""
    settings = ir.RenderSettings(width=64, height=64, iterations=2, light_paths=128, estimator=estimator)
    cpu = ir.render(room(), settings).radiance()
    gpu = ir.render(room(), settings, device="cuda:0").radiance()
    different = np.abs(cpu - gpu).max(axis=2) > 2e-3 * cpu.mean()
    if estimator != "vpl":  # which weighs its VPLs in another order there, and so chooses others
        assert different.mean() <= 0.05
    assert gpu.mean() == pytest.approx(cpu.mean(), rel=2e-2 if estimator == "vpl" else 2e-3)
