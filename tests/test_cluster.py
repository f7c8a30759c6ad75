"""A Ray cluster of several nodes on this machine: nodes and workers are shot while they work, and no bit changes."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import warp_ir as ir
from warp_ir.cli import main
from warp_ir.engine import Devices, render_parts
from warp_ir.image.io import read_image

sys.modules.setdefault("rfc3987_syntax", None)  # its import takes 4 s, in every process of Ray (see `cluster`)
pytest.importorskip("ray", reason="needs the extra 'cluster'")

pytestmark = [
    pytest.mark.extended,
    pytest.mark.xdist_group("ray"),
    # Ray leaves pipes and files of its processes to be closed by the interpreter.
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::FutureWarning"),
]
ROOT = Path(__file__).parent.parent
ROOM, TURNTABLE = (str(ROOT / "scenes_usd" / f"{name}.usda") for name in ("two_rooms", "turntable"))
SMALL = {"width": 40, "light_paths": 32}
STORE = 80 << 20
"""Size of a node's object store [bytes]; 75 MiB are the least that Ray takes."""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A head that renders nothing, and a node of one CPU; they run this repository's code, without telemetry."""
    from ray.cluster_utils import Cluster

    # jsonschema checks formats by a package that takes 4 s of CPU time to import, if an extra has installed it; Ray
    # imports jsonschema in each of its processes, and ends them if they are not up after 15 s.
    quick = tmp_path_factory.mktemp("quick")
    (quick / "rfc3987_syntax.py").write_text("raise ImportError('not needed here')\n")
    before = dict(os.environ)
    os.environ |= {
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(quick), os.environ.get("PYTHONPATH", "")]),
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_worker_register_timeout_seconds": "300",
    }
    head = {"num_cpus": 0, "include_dashboard": False, "no_monitor": True, "object_store_memory": STORE}
    cluster = Cluster(initialize_head=True, head_node_args=head | ports())
    add_node(cluster)
    yield cluster
    cluster.shutdown()
    os.environ.clear()
    os.environ.update(before)


def ports():
    """Ports for a node's agents: where they are not given, a node waits for its agents no longer than 15 s."""
    free = {}
    for name in ("metrics_agent_port", "metrics_export_port", "runtime_env_agent_port"):
        with socket.socket() as any_port:
            any_port.bind(("", 0))
            free[name] = any_port.getsockname()[1]
    return free


def add_node(cluster):
    return cluster.add_node(num_cpus=1, object_store_memory=STORE, **ports())


def workers_of(node, name="_render_part"):
    """Process ids of the workers of a node that are at a task of a name."""
    raylet = node.all_processes["raylet"][0].process.pid
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            command = (folder / "cmdline").read_bytes().decode()
        except (OSError, ValueError):
            continue
        if parent == raylet and command.startswith(f"ray::{name}"):
            found.append(int(folder.name))
    return found


def wait_for(what, seconds=60.0):
    """Waits until `what()` is true, and returns it."""
    deadline = time.monotonic() + seconds
    while not (got := what()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert got
    return got


@pytest.fixture
def executor(cluster):
    from warp_ir.engine.ray_cluster import RayCluster

    executor = RayCluster("cpu", address=cluster.address, threads=1)
    yield executor
    executor.close()


def render(executor, settings, progress=None, size=2, stage=ROOM):
    renderer = ir.Renderer(ir.load_usd(stage), ir.RenderSettings(**SMALL | settings), threads=1)
    film = render_parts(renderer, executor, progress=progress, size=size)
    if isinstance(executor, Devices):
        executor.close()
    return film


def assert_same(one, other):
    """Two films are the same, bit for bit."""
    assert one.iterations == other.iterations
    np.testing.assert_array_equal(one.tile_iterations, other.tile_iterations)
    np.testing.assert_array_equal(one.radiance(), other.radiance())
    np.testing.assert_array_equal(one.standard_error(), other.standard_error())


def test_a_node_and_a_worker_are_shot_and_one_is_added(cluster, executor):
    """Over a full object store too, the picture has the bits of an undisturbed one, and parts wait in order.

    The films of the 14 parts are 27 MB each, and eight of them are ahead of the one that is added next: more than two
    nodes' stores hold, so that some are written to disk.
    """
    settings = {"width": 480, "max_bounces": 0, "light_paths": 16, "iterations": 14}
    doomed = add_node(cluster)
    (first,) = [node for node in cluster.worker_nodes if node is not doomed]
    happened = []

    def disturb(progress):
        if progress.iterations == 2:
            os.kill(wait_for(lambda: workers_of(first))[0], signal.SIGKILL)
            happened.append("worker")
        if progress.iterations == 4:
            wait_for(lambda: workers_of(doomed))
            cluster.remove_node(doomed, allow_graceful=False)
            happened.append("node")
        if progress.iterations == 6:
            add_node(cluster)
            # Meanwhile films gather in the stores.
            wait_for(lambda: list(Path(cluster.head_node.get_session_dir_path()).glob("ray_spilled_objects*/*")))
            happened.append("added")

    disturbed = render(executor, settings, disturb, size=1)
    assert happened == ["worker", "node", "added"]
    assert_same(disturbed, render(Devices(["cpu"], 1), settings, size=1))


def test_rounds_limits_and_errors(executor):
    """Adaptive rounds have the bits of one device; a time limit ends in time; what a worker cannot do is one line."""
    from warp_ir.engine.ray_cluster import StageSource

    settings = {"target_error": 0.1}
    assert_same(render(executor, settings), render(Devices(["cpu"], 1), settings))
    film = render(executor, {"time_limit": 3.0})
    assert 1 <= film.iterations and film.seconds < 6.0
    executor.source = StageSource(TURNTABLE, {}, None, None)
    with pytest.raises(ir.InputError, match=r"turntable\.usda: is another scene where a worker reads it"):
        render(executor, {"iterations": 4})
    executor.source = StageSource(str(ROOT / "gone.usda"), {}, None, None)
    with pytest.raises(ir.InputError, match=r"gone\.usda"):
        render(executor, {"iterations": 4})
    executor.source = StageSource(ROOM, {}, None, None)
    assert render(executor, {"iterations": 4}).iterations == 4


def test_a_lost_driver_goes_on(cluster, tmp_path):
    """Kill -9 of the command, then --resume; and Ctrl-C, which cancels: the bits of one device, no trace beside it."""
    words = ["-w", "96", "--light-paths", "32", "--iterations", "40", "--part-iterations", "2", "--checkpoint", "0.05"]
    more = ["--engine", "ray", "--address", cluster.address, "--threads", "1", "--device", "cpu"]
    picture, whole = tmp_path / "a.npy", tmp_path / "whole.npy"
    film = tmp_path / "a.npy.film.npz"
    command = [sys.executable, "-m", "warp_ir", "render", ROOM, str(picture), *words, *more]
    with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
        wait_for(lambda: film.exists() or process.poll() is not None)
        process.kill()
    assert not picture.exists()
    with subprocess.Popen([*command, "--resume"], stderr=subprocess.PIPE, text=True) as process:
        begun = film.stat().st_mtime_ns
        wait_for(lambda: film.stat().st_mtime_ns != begun or process.poll() is not None)
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and "--resume continues from this checkpoint" in said, said
    assert main(["render", ROOM, str(picture), *words, "--device", "cpu,cpu", "--threads", "1", "-q", "--resume"]) == 0
    assert main(["render", ROOM, str(whole), *words, "--device", "cpu,cpu", "--threads", "1", "-q"]) == 0
    np.testing.assert_array_equal(read_image(picture), read_image(whole))
    assert sorted(os.listdir(tmp_path)) == ["a.npy", "whole.npy"]


def test_frames_are_tasks_where_files_are_shared(cluster, tmp_path, capsys):
    """Frames have the bits that they have alone; one whose worker is shot goes on in another."""
    import ray

    words = ["-w", "48", "--light-paths", "32", "--iterations", "30", "--frames", "1:3"]
    alone = ["render", TURNTABLE, str(tmp_path / "alone.#.npy"), *words, "--device", "cpu", "-q"]
    assert main(alone) == 0
    more = ["--engine", "ray", "--address", cluster.address, "--shared-files", "--device", "cpu", "--threads", "1"]
    stats = ["--checkpoint", "0.05", "--stats", str(tmp_path / "stats.json")]
    command = ["render", TURNTABLE, str(tmp_path / "ray.#.npy"), *words, *more, *stats]
    with subprocess.Popen([sys.executable, "-m", "warp_ir", *command], stdout=subprocess.PIPE, text=True) as process:
        films = [tmp_path / f"ray.{frame}.npy.film.npz" for frame in (1, 2, 3)]
        wait_for(lambda: any(film.exists() for film in films) or process.poll() is not None)
        shot = [pid for node in cluster.worker_nodes for pid in workers_of(node, "_render_frame")]
        for pid in shot:
            os.kill(pid, signal.SIGKILL)
        said = process.communicate(timeout=120)[0]
    assert process.returncode == 0 and shot
    assert [line.partition(":")[0][-9:] for line in said.splitlines()] == [f"ray.{frame}.npy" for frame in (1, 2, 3)]
    for frame in (1, 2, 3):
        one, other = (read_image(tmp_path / f"{name}.{frame}.npy") for name in ("ray", "alone"))
        np.testing.assert_array_equal(one, other)
    assert [each["frame"] for each in json.loads((tmp_path / "stats.json").read_text())["frames"]] == [1, 2, 3]
    assert not ray.is_initialized() and not list(tmp_path.glob("*.film.npz"))


def test_a_cluster_that_is_not_there(capsys):
    """One line, and no cluster is started in its place."""
    words = ["--engine", "ray", "--address", "127.0.0.1:1", "--device", "cpu"]
    assert main(["render", ROOM, "a.npy", *words]) == 2
    said = capsys.readouterr().err
    assert "--address: no Ray cluster at '127.0.0.1:1'" in said and said.count("\n") == 1, said
    assert main(["render", ROOM, "a.npy", "--engine", "ray", "--address", "ray://a:1"]) == 2
    assert "must be HOST:PORT or auto" in capsys.readouterr().err
