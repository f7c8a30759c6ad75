"""Every kernel compiles for CUDA, on a machine that has none; and computes the same where there is one."""

import numpy as np
import pytest
import warp as wp

import warp_ir as ir
import warp_ir.estimators.keller
import warp_ir.estimators.path
import warp_ir.film
import warp_ir.gbuffer
import warp_ir.vpl
from tests.physics.test_invariance import room

KERNEL_MODULES = [
    warp_ir.gbuffer,
    warp_ir.vpl,
    warp_ir.film,
    warp_ir.estimators.keller,
    warp_ir.estimators.path,
]


@pytest.mark.parametrize("module", KERNEL_MODULES, ids=lambda m: m.__name__)
@pytest.mark.parametrize("arch", [75, 90])
def test_kernels_compile_for_cuda(module, arch, tmp_path):
    """Turing and Hopper machine code comes out of every module."""
    wp.compile_aot_module(module, arch=arch, module_dir=tmp_path, use_ptx=False)
    assert [p.stat().st_size > 0 for p in tmp_path.glob("*.cubin")] == [True]


@pytest.mark.gpu
@pytest.mark.parametrize("estimator", ["keller", "path"])
def test_cuda_agrees_with_cpu(estimator):
    """The same picture up to rounding: the samples are the same numbers; a ray at an edge may fall the other way."""
    settings = ir.RenderSettings(width=64, height=64, iterations=2, light_paths=128, estimator=estimator)
    cpu = ir.render(room(), settings).radiance()
    gpu = ir.render(room(), settings, device="cuda:0").radiance()
    different = np.abs(cpu - gpu).max(axis=2) > 2e-3 * cpu.mean()
    assert different.mean() <= (0.02 if estimator == "keller" else 0.05)
    assert gpu.mean() == pytest.approx(cpu.mean(), rel=2e-3)
