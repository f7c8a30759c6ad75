"""Flags for where the iterations of a render run, and what stands behind them."""

import argparse
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from warp_ir.cli.console import muted_stderr
from warp_ir.cli.import_guard import importing
from warp_ir.cli.stage_options import reader_options
from warp_ir.scene import InputError

if TYPE_CHECKING:
    from warp_ir.cli.frames import TimeCode
    from warp_ir.engine import Executor
    from warp_ir.engine.ray_cluster import RayCluster, StageSource
    from warp_ir.usd.settings.render_spec import Product

DESTINATIONS = frozenset({"engine", "workers", "address", "shared_files", "part_iterations"})
"""Destinations of these flags: a picture does not depend on them, but for rounding."""


def add_engine(parser: argparse.ArgumentParser, count: Callable[[str], int]) -> None:
    """Adds the flags; `count` parses numbers of workers."""
    group = parser.add_argument_group("several devices, many machines (docs/cluster.md)")
    engine = "ray: share the iterations out to a Ray cluster (extra 'cluster'); --threads are the CPUs of a worker"
    group.add_argument("--engine", choices=("ray",), help=engine)
    address = "HOST:PORT of the cluster, or auto (default: a cluster on this machine, which ends with the command)"
    group.add_argument("--address", metavar="HOST:PORT", help=address)
    workers = "largest number of workers (default: as many as the cluster has room for)"
    group.add_argument("--workers", type=count, metavar="N", help=workers)
    shared = "workers read the stage by its path, and frames of an animation are rendered and written there"
    group.add_argument("--shared-files", action="store_true", help=shared)
    size = "iterations of a part that is rendered in one place (default: from the size of the picture)"
    group.add_argument("--part-iterations", type=_iterations, metavar="N", help=size)


def check_engine(args: argparse.Namespace) -> None:
    """Raises `InputError` if flags have no effect, or contradict each other."""
    given = {"--address": args.address, "--workers": args.workers, "--shared-files": args.shared_files}
    if args.engine is None:
        for flag in (flag for flag, value in given.items() if value):
            raise InputError(f"{flag}: has no effect without --engine ray")
        if args.part_iterations and "," not in args.device:
            raise InputError("--part-iterations: has no effect without --engine ray or several devices")
    elif args.device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device: {args.device!r}: a Ray cluster chooses which; give cpu or cuda")


@contextmanager
def open_executor(args: argparse.Namespace) -> "Iterator[Executor | None]":
    """What renders the parts of the pictures, while the context lasts; None: they have none.

    Raises:
        InputError: There is no such cluster, or the devices do not fit together.
    """
    check_engine(args)
    if args.engine is None and "," not in args.device:
        yield None
        return
    with importing():
        from warp_ir.engine import Devices
    if args.engine is None:
        try:
            devices = Devices(args.device.split(","), args.threads)
        except InputError as error:
            raise InputError(f"--{error}") from None
        try:
            yield devices
        finally:
            devices.close()
        return
    with importing():
        from warp_ir.engine.ray_cluster import RayCluster
    with muted_stderr(not args.verbose):
        try:
            cluster = RayCluster(args.device, address=args.address, workers=args.workers, threads=args.threads)
        except InputError as error:
            raise InputError(f"--{error}") from None
    try:
        yield cluster
    finally:
        with muted_stderr(not args.verbose):
            cluster.close()


def device_of(args: argparse.Namespace, executor: "Executor | None") -> str:
    """The device that makes the picture: with several devices, the first."""
    if args.engine is not None:
        assert executor is not None
        return "auto" if executor.kind == "cuda" else "cpu"
    device: str = args.device.partition(",")[0]
    return device


def stage_source(args: argparse.Namespace, time: "TimeCode", product: "Product | None") -> "StageSource":
    """The stage as workers read it by its path."""
    from warp_ir.engine.ray_cluster import StageSource

    options = reader_options(args)
    if args.session_layer is not None:
        options["session_layer"] = os.path.abspath(args.session_layer)
    return StageSource(os.path.abspath(args.stage), options, time, product)


def as_cluster(executor: "Executor | None") -> "RayCluster | None":
    """The executor if it is a Ray cluster."""
    if executor is None:
        return None
    from warp_ir.engine import Devices

    return None if isinstance(executor, Devices) else executor  # type: ignore[return-value]  # there are two


def _iterations(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text[:10]) < 2**31:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, is {text!r}")
    return int(text)
