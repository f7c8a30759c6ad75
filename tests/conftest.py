"""What every test shares: which devices to run on, and a quiet Warp."""

import pytest
import warp as wp

wp.config.log_level = wp.LOG_WARNING
wp.init()


def pytest_addoption(parser):
    parser.addoption("--device", help="run the tests that take a device on this one alone, e.g. cuda:0")


def pytest_generate_tests(metafunc):
    if "device" in metafunc.fixturenames:
        only = metafunc.config.getoption("--device")
        names = [only] if only else ["cpu", *(["cuda:0"] if wp.is_cuda_available() else [])]
        metafunc.parametrize("device", names)


@pytest.fixture(scope="session")
def launcher():
    """Kernels on all CPU cores."""
    from warp_ir.device.launcher import Launcher

    return Launcher("cpu")
