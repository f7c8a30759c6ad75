"""What every test shares: which devices to run on, and a quiet Warp."""

import gc

import pytest
import warp as wp

wp.config.log_level = wp.LOG_WARNING
wp.init()

_LAUNCHING = {
    *("Launcher", "LiveView", "Renderer", "device", "exec", "launcher", "main", "render", "trace_vpls", "upload_scene"),
    *("LiveScene", "SensorCamera", "Views", "boxes", "pair", "view_of"),
}
"""Fixtures and names by which most tests that launch kernels can be told; all of tests/physics do."""


def pytest_addoption(parser):
    parser.addoption("--device", help="run the tests that take a device on this one alone, e.g. cuda:0")


def pytest_generate_tests(metafunc):
    if "device" in metafunc.fixturenames:
        only = metafunc.config.getoption("--device")
        names = [only] if only else ["cpu", *(["cuda:0"] if wp.is_cuda_available() else [])]
        metafunc.parametrize("device", names)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Tests that launch kernels share a process under `--dist loadgroup`, so that no module is compiled twice."""
    for item in items:
        if item.path.parent.name == "physics" or _LAUNCHING & {*item.fixturenames, *item.function.__code__.co_names}:
            item.add_marker(pytest.mark.xdist_group("kernels"))


def pytest_collection_finish():
    """Modules and tests are no garbage; every collection would look through half a million objects of theirs."""
    gc.freeze()


@pytest.fixture(scope="session")
def launcher():
    """Kernels on all CPU cores."""
    from warp_ir.device.launcher import Launcher

    return Launcher("cpu")
