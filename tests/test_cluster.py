"""Batches on a Ray cluster: the same results as on this machine, whatever happens to its processes and nodes.

The cluster asks for a token, as Ray does unless told otherwise; so every test here shows that ours is offered.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from runs import CUBE, samples_of

import warpjelly as wj
from warpjelly import cli
from warpjelly.batch import cluster
from warpjelly.batch.cluster import RayEngine
from warpjelly.batch.jobs import Job, Result, Watcher
from warpjelly.batch.rayjobs import do_job
from warpjelly.device import gpus
from warpjelly.errors import EnvironmentFailedError, InputError
from warpjelly.files import locked
from warpjelly.scenefile import load_scene
from warpjelly.stage.validate import stage_problems

STIFFNESS = "materials.jelly.structural.stiffness"
SETTINGS = {"bodies.cube.particles_per_edge": 3, "frames": 240}
TOKEN = "0123456789abcdef" * 4
# Whatever takes longer than this has failed, s: the cluster and its processes share the machine.
PATIENCE = 90.0
# Ray's least, bytes.
STORE = 80_000_000


@dataclass
class Nodes:
    """A cluster of two nodes on this machine, each with one processor."""

    ray: Any
    second: Any

    @property
    def address(self) -> str:
        """Where the cluster is."""
        return self.ray.address

    def has_second(self, process: int) -> bool:
        """Say whether a process is one of the second node."""
        raylet = self.second.all_processes["raylet"][0].process.pid
        return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1]) == raylet

    def lose_second(self) -> None:
        """Kill the second node."""
        self.ray.remove_node(self.second, allow_graceful=False)


@pytest.fixture(scope="module")
def nodes() -> Iterator[Nodes]:
    """Start a cluster, and offer its token to it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "token")
        patch.setenv("RAY_AUTH_TOKEN", TOKEN)
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        from ray.cluster_utils import Cluster

        ray = Cluster()
        try:
            ray.add_node(num_cpus=1, object_store_memory=STORE, include_dashboard=False)
            # Ray takes it at its word that there is a GPU.
            yield Nodes(ray, ray.add_node(num_cpus=1, num_gpus=1, object_store_memory=STORE))
        finally:
            ray.shutdown()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Any]:
    """Return a function that starts a sweep over stiffnesses on a cluster, in a process of its own."""
    started: list[subprocess.Popen[str]] = []

    def start(nodes: Nodes, values: Sequence[float], *options: str, **environment: str) -> subprocess.Popen[str]:
        told = "".join(f'"{name}" = {value}\n' for name, value in SETTINGS.items())
        vary = f'[vary.k]\nkeys = ["{STIFFNESS}"]\nvalues = {json.dumps(values)}\n'
        (tmp_path / "sweep.toml").write_text(f"base = '{tmp_path / 'cube.toml'}'\nname = 'k{{k}}'\n[set]\n{told}{vary}")
        text = CUBE.read_text()
        (tmp_path / "cube.toml").write_text("".join(ln for ln in text.splitlines(True) if "duration" not in ln))
        command = [
            sys.executable,
            "-m",
            "warpjelly.cli",
            "batch",
            "sweep.toml",
            "-o",
            "out",
            "--device=cpu",
            "--no-pictures",
        ]
        pipe = subprocess.PIPE
        process = subprocess.Popen(
            [*command, "--engine=ray", "--address", nodes.address, *options],
            cwd=tmp_path,
            stdout=pipe,
            stderr=pipe,
            text=True,
            env={**os.environ, **environment},
        )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
            process.communicate()


def writer_of(run: Path, batch: subprocess.Popen[str], frames: int = 30) -> int:
    """Return the process that writes a run, as soon as that has some frames."""
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        try:
            if (run / "metrics.csv").read_bytes().count(b"\n") > frames:
                return int((run / "run.lock").read_text())
        except (OSError, ValueError):
            pass
        assert batch.poll() is None, batch.communicate()
        time.sleep(0.005)
    raise TimeoutError


def stopped_writers_of(folder: Path, batch: subprocess.Popen[str]) -> dict[str, int]:
    """Return the processes of two runs by name, both stopped after some frames."""
    writers = {}
    for name in ("k50", "k100"):
        writers[name] = writer_of(folder / name, batch)
        os.kill(writers[name], signal.SIGSTOP)
    return writers


def assert_as_alone(runs: Sequence[Path], tmp_path: Path) -> None:
    """Hold the runs of a batch against single runs of the same scenes, to the bit."""
    for run in runs:
        stiffness = float(run.name.removeprefix("k"))
        alone = tmp_path / f"alone_{run.name}"
        scene = load_scene(tmp_path / "cube.toml", overrides={**SETTINGS, STIFFNESS: stiffness})
        wj.simulate(scene, output=alone, device="cpu")
        assert stage_problems(run) == []
        assert samples_of(run) == samples_of(alone)
        assert (run / "metrics.csv").read_bytes() == (alone / "metrics.csv").read_bytes()


def do(engine: RayEngine, jobs: Sequence[Job], watcher: Watcher | None = None) -> list[Result]:
    """Have an engine do jobs, in a folder that is ours."""
    until = time.monotonic() + PATIENCE

    def stopping() -> bool:
        assert time.monotonic() < until, "the cluster does not end"
        return False

    with locked(jobs[0].folder.parent), engine:
        return list(engine.run(jobs, watcher=watcher or Watcher(), stopping=stopping))


class Remarks(Watcher):
    """Keeps what people should know."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, line: str) -> None:
        """Keep a line."""
        self.said.append(line)


@pytest.mark.cluster
def test_a_killed_process_is_replaced_and_errors_are_not_repeated(nodes, start, tmp_path):
    """Kill a process of a run: that goes on where it was, to the same bits; a run that diverges is done once."""
    batch = start(nodes, [50, 100, 1e9], "--json")
    os.kill(writer_of(tmp_path / "out" / "k100", batch), signal.SIGKILL)
    out, err = batch.communicate(timeout=PATIENCE)
    record = json.loads(out)
    assert batch.returncode == 3, err
    assert record == json.loads((tmp_path / "out" / "batch.json").read_text())
    assert (record["engine"], record["workers"]) == ("ray", 2)
    assert [(run["status"], run["attempts"]) for run in record["runs"]] == [
        ("finished", 1),
        ("finished", 2),
        ("failed", 1),
    ]
    log = (tmp_path / "out" / "k100" / "run.log").read_text()
    assert log.index("begun in process") < log.index("going on in process")
    assert len(err.splitlines()) == 4, err
    assert "k100: finished, begun 2 times; " in err
    assert_as_alone([tmp_path / "out" / "k50", tmp_path / "out" / "k100"], tmp_path)


@pytest.mark.cluster
def test_ctrl_c_saves_what_is_under_way_and_resume_goes_on(nodes, start, tmp_path):
    """Interrupt two runs on two nodes while a third waits, and go on with all of them."""
    batch = start(nodes, [50, 100, 150])
    writers = stopped_writers_of(tmp_path / "out", batch)
    batch.send_signal(signal.SIGINT)
    # On its way through three processes.
    time.sleep(2.0)
    for process in writers.values():
        os.kill(process, signal.SIGCONT)
    out, err = batch.communicate(timeout=PATIENCE)
    assert batch.returncode == 130, err
    record = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert record["counts"] == {"runs": 3, "finished": 0, "failed": 0, "unfinished": 3}
    assert [run["attempts"] for run in record["runs"]] == [1, 1, 0]
    assert [run["figures"]["frames"] >= 30 for run in record["runs"][:2]] == [True, True]
    assert (out.count("\n"), err.count("error: interrupted: 0 of 3 runs are finished")) == (3, 1)
    batch = start(nodes, [50, 100, 150], "--resume")
    out, err = batch.communicate(timeout=PATIENCE)
    assert batch.returncode == 0, err
    for name in ("k50", "k100"):
        assert "going on in process" in (tmp_path / "out" / name / "run.log").read_text()
    assert_as_alone([tmp_path / "out" / "k50", tmp_path / "out" / "k100"], tmp_path)


@pytest.mark.cluster
def test_what_no_node_can_take_is_reported(nodes, tmp_path, monkeypatch):
    """Ask for more memory than there is, beside a job that raises what nobody foresaw."""
    # Longer than Ray takes to begin with the other job.
    monkeypatch.setattr(cluster, "NODE_PATIENCE", 15.0)
    scene = load_scene(CUBE)
    # As a lost process leaves it.
    (tmp_path / "large").mkdir()
    (tmp_path / "large" / "run.lock").write_text("1")
    # More than Ray can ask for, of which it has the smallest only, and so many that they would fill its queue.
    large = [Job("large" if n == 3 else f"larger{n}", scene, tmp_path / "large", 10**16 - n) for n in range(4)]
    odd = Job("odd", 1.0, tmp_path / "odd", 10**8)  # type: ignore[arg-type]
    engine, remarks = RayEngine(address=nodes.address, device="cpu"), Remarks()
    ended = do(engine, [*large, odd], remarks)
    assert ended[0].name == "odd"
    results = {result.name: result for result in ended}
    assert (results["odd"].exit_code, results["odd"].attempts) == (4, 1)
    assert str(results["odd"].reason).startswith("internal error: AttributeError: 'float' object has no ")
    why = "no node of the cluster is large enough: it needs 10000000.00 GB of memory; the largest node has "
    assert len(results) == 5
    for job in large:
        assert results[job.name].exit_code == 4
        assert str(results[job.name].reason).startswith(why)
    (remark,) = remarks.said
    assert remark.startswith(f"large waits for a node, at most 0.25 minutes: {why}")


@pytest.mark.cluster
def test_a_gpu_is_taken_where_the_cluster_has_one(nodes, tmp_path):
    """Leave the device to the engine; what it chooses may not be there, which the run says."""
    job = Job("a", load_scene(CUBE, frames=3), tmp_path / "a", 10**8)
    (result,) = do(engine := RayEngine(address=nodes.address), [job])
    # Both nodes have a processor, and one of them a GPU.
    assert engine.workers == 1
    if "cuda:0" in gpus():
        assert json.loads((tmp_path / "a" / "run.json").read_text())["device"] == "cuda:0"
    else:
        assert (result.exit_code, result.reason) == (2, "device cuda:0: not on this machine, which has cpu")


@pytest.mark.cluster
def test_a_lost_node_is_replaced_and_one_that_sees_other_folders_is_left_alone(nodes, start, tmp_path, monkeypatch):
    """Kill one of two nodes: its run goes on at the other. Give that one a folder that means another to it."""
    batch = start(nodes, [50, 100])
    writers = stopped_writers_of(tmp_path / "out", batch)
    (lost,) = (name for name, process in writers.items() if nodes.has_second(process))
    nodes.lose_second()
    # With a machine goes all that runs on it.
    os.kill(writers.pop(lost), signal.SIGKILL)
    (other,) = writers.values()
    os.kill(other, signal.SIGCONT)
    _, err = batch.communicate(timeout=PATIENCE)
    assert batch.returncode == 0, err
    record = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert {run["name"]: run["attempts"] for run in record["runs"]} == {"k50": 1, "k100": 1} | {lost: 2}
    assert "going on in process" in (tmp_path / "out" / lost / "run.log").read_text()
    assert_as_alone([tmp_path / "out" / "k50", tmp_path / "out" / "k100"], tmp_path)

    # The working directory, which is another one for every process.
    monkeypatch.chdir(tmp_path)
    job = Job("a", load_scene(CUBE), Path("/proc/self/cwd/a"), 10**8)
    (result,) = do(RayEngine(address=nodes.address, device="cpu"), [job], watcher := Remarks())
    why = f"node {socket.gethostname()} does not see /proc/self/cwd, which has to be on a file system that all nodes "
    why += "share"
    assert (result.exit_code, result.reason) == (4, f"no node takes it: {why}")
    assert watcher.said == [f"{why}; it gets no more runs"]


@pytest.mark.cluster
def test_another_token_is_refused_at_once(nodes, start, tmp_path):
    """Offer another token: a line within seconds, nothing written, and nothing but the lock's folder made."""
    began = time.monotonic()
    batch = start(nodes, [50], RAY_AUTH_TOKEN="f" * 64)
    out, err = batch.communicate(timeout=PATIENCE)
    assert (batch.returncode, out) == (4, "")
    assert "the cluster wants an authentication token that this machine does not have" in err
    assert err.count("\n") == 1
    assert list((tmp_path / "out").iterdir()) == []
    assert time.monotonic() - began < cluster.CLUSTER_PATIENCE


@pytest.mark.cluster
def test_addresses_without_a_cluster(monkeypatch):
    """Name what is no address, where nobody listens, and where somebody does who is not Ray."""
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setattr(cluster, "CLUSTER_PATIENCE", 2.0)
    for address in ("here", "ray://here:1", "here:there", ":1"):
        with pytest.raises(InputError, match=f"address {address}: give HOST:PORT, as 'ray start --head' says it"):
            RayEngine(address=address)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with (
            pytest.raises(EnvironmentFailedError, match="no answer from a Ray cluster within 2 s"),
            RayEngine(address=f"127.0.0.1:{port}"),
        ):
            pass
    nobody = f"127.0.0.1:{port}: no Ray cluster there: Connection refused"
    with pytest.raises(EnvironmentFailedError, match=nobody), RayEngine(address=f"127.0.0.1:{port}"):
        pass


def test_without_ray_and_without_sense(monkeypatch):
    """Ask for what needs Ray where it is not installed, for a certain GPU, and for an address of nothing."""
    with monkeypatch.context() as patch:
        patch.setattr(cluster, "find_spec", lambda name: None)
        with pytest.raises(InputError, match=r"needs Ray: pip install 'warpjelly\[cluster\]'"):
            RayEngine()
    monkeypatch.setattr(cluster, "find_spec", lambda name: True)
    with pytest.raises(InputError, match="device cuda:1: on a cluster Ray chooses the GPU"):
        RayEngine(device="cuda:1")
    with pytest.raises(InputError, match="--address is that of a Ray cluster: add --engine ray"):
        cli.batch([CUBE], address="here:1")


def test_a_node_with_another_version_says_so(monkeypatch, tmp_path):
    """Do a job as on a node whose package is not that of the batch, or is missing."""
    node = SimpleNamespace(get_node_id=lambda: "id")
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(get_runtime_context=lambda: node))
    arguments: dict[str, Any] = {"batch": str(tmp_path), "owner": "1", "device": "cpu", "threads": 1}
    host = f"node {socket.gethostname()}"
    there = importlib.metadata.version("warpjelly")
    assert do_job(b"", version="0.0", **arguments) == ("id", None, f"{host} has warpjelly {there}, not 0.0")
    monkeypatch.setitem(sys.modules, "warpjelly.batch.rayjobs", None)
    assert do_job(b"", version="0.0", **arguments)[2].startswith(f"{host} has no warpjelly 0.0: ")
