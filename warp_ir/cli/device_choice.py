"""Chooses the device on which a command runs."""

from warp_ir.cli.console import muted_stderr, warn
from warp_ir.cli.import_guard import importing
from warp_ir.scene import InputError


def open_device(name: str, *, verbose: bool = False) -> str:
    """Starts Warp and returns the device's name.

    Args:
        name: "cpu", "cuda", "cuda:N", or "auto" for the first GPU or else the CPU.
        verbose: Whether Warp may print messages.

    Raises:
        InputError: The device does not exist, and the message names those that do; or no folder for compiled kernels.
    """
    with importing():
        import warp as wp

        from warp_ir.device.compiling import start_warp

    # The command owns the process: its own messages replace those of Warp.
    wp.config.log_level = wp.LOG_INFO if verbose else wp.LOG_ERROR
    with muted_stderr(not verbose):
        warning = start_warp()
        devices = [str(device) for device in wp.get_devices()]
    if warning:
        warn(warning)
    gpus = [device for device in devices if device.startswith("cuda")]
    if name in ("auto", "cuda"):
        chosen = gpus[0] if gpus else "cpu" if name == "auto" else name
    else:
        chosen = name
    if chosen not in devices:
        raise InputError(f"--device: {name!r} is not available; available: {', '.join(devices)}")
    return chosen
