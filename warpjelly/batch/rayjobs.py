"""The process that speaks with Ray: hands jobs to a cluster, looks after them, and says on stdout how they go."""

from __future__ import annotations

import itertools
import os
import pickle
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

from ..checkpoint import version_of
from ..errors import INTERRUPTED, EnvironmentFailedError, InputError, verdict
from ..files import LOCK_NAME, wait_for_lock
from ..rundir import METRICS_NAME
from .jobs import Job, Result
from .perform import perform

# A job whose process or node was lost is begun so often in all: on a large cluster, nodes come and go.
ATTEMPTS = 3
# So many jobs for each one that the cluster does at a time are in its hands.
QUEUED = 2
# How often to look for results, s; and for progress, and for nodes that come and go.
INTERVAL, SURVEY_INTERVAL = 0.1, 1.0
# How long the lock of a run directory may outlive the node that had it, s: NFS servers wait 90 s for a client.
LEASE = 120.0
# Processors of a job. A run has one thread.
THREADS = 1
# What became of a job that was interrupted, but not by us.
_ENDED = "its process was told to end"
# What became of a job whose result Ray does not have, by the name of its exception.
_LOST = {
    "NodeDiedError": "its node was lost",
    "OutOfMemoryError": "its node ran out of memory",
    "WorkerCrashedError": "its process was killed",
}
# What to tell people whom the cluster does not know.
OTHER_TOKEN = (
    "the cluster wants an authentication token that this machine does not have; copy the one that it was started with "
    "to ~/.ray/auth_token, and set RAY_AUTH_MODE=token"
)
# More memory Ray cannot ask for, bytes: it counts in 10^-4 bytes, with 64 bits.
MOST_MEMORY = 9 * 10**14
# What every node is labelled with by Ray.
_NODE_LABEL = "ray.io/node-id"
# How often to look for a file that another machine has just written, once a second.
SIGHT_ATTEMPTS = 5
# The end of metrics.csv in which its last row must be, bytes.
_TAIL = 8192


@dataclass(frozen=True)
class Connected:
    """The cluster does so many jobs at a time."""

    workers: int


@dataclass(frozen=True)
class Refused:
    """It goes no further."""

    exit_code: int
    reason: str


@dataclass(frozen=True)
class Progress:
    """A job has so many frames."""

    worker: str
    name: str
    done: int


@dataclass(frozen=True)
class Ended:
    """A worker has ended a job; one that was not begun has no attempts."""

    worker: str
    result: Result


@dataclass(frozen=True)
class Remark:
    """What people should know."""

    text: str


@dataclass
class _Task:
    """An attempt at a job, which the cluster has."""

    job: Job
    attempt: int
    slot: int
    """A number that no other task has meanwhile."""
    misfit_since: float | None = None
    """Since when no node is large enough for it."""


def drive() -> None:
    """Connect to a cluster and do the jobs that arrive on stdin, until nobody hears it any more."""
    messages = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    address, limit, device, patience = pickle.load(sys.stdin.buffer)
    orders: queue.SimpleQueue[Sequence[Job] | None] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(sys.stdin.buffer, orders), daemon=True).start()
    try:
        ray = _connect(address)
    except _RefusedError as error:
        _send(messages, Refused(*error.args))
        return
    drover = Drover(ray, messages, limit=limit, device=device, patience=patience)
    while True:
        drover.survey()
        with suppress(queue.Empty):
            order = orders.get(block=not drover.is_busy(), timeout=SURVEY_INTERVAL)
            drover.stop() if order is None else drover.take(order)
        drover.give_out()
        drover.collect()


class _RefusedError(Exception):
    """There is no cluster for us; exit code and reason."""


def _connect(address: str) -> Any:
    """Return Ray's module, connected to a cluster.

    Raises:
        _RefusedError: there is none.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except ray.exceptions.AuthenticationError as error:
        raise _RefusedError(EnvironmentFailedError.exit_code, f"{address}: {OTHER_TOKEN}") from error
    except Exception as error:
        if address == "auto":
            why = (
                "this machine is not part of a Ray cluster: start one with 'ray start --head', join one with 'ray "
                "start --address=HOST:PORT', or give its --address"
            )
            raise _RefusedError(InputError.exit_code, why) from error
        why = f"{address}: no Ray cluster there: {' '.join(str(error).split())}"
        raise _RefusedError(EnvironmentFailedError.exit_code, why) from error
    return ray


def _send(messages: BinaryIO, message: object) -> None:
    pickle.dump(message, messages)
    messages.flush()


def _listen(source: BinaryIO, orders: queue.SimpleQueue[Any]) -> None:
    """Take orders in until there is nobody any more to give them; then end the process, and so all of its tasks."""
    while True:
        try:
            orders.put(pickle.load(source))
        except (EOFError, pickle.UnpicklingError):
            os._exit(0)


class Drover:
    """Brings jobs to a cluster, and sees to it that something comes of each.

    Args:
        ray: Ray's module, connected.
        messages: where to say how it goes.
        limit: how many jobs at a time, None for as many as there is room for.
        device: "cpu", "cuda:0" or "auto".
        patience: how long a job may wait for a node that is large enough for it, s.
    """

    def __init__(self, ray: Any, messages: BinaryIO, *, limit: int | None, device: str, patience: float) -> None:
        self._ray, self._messages, self._limit, self._patience = ray, messages, limit, patience
        self._waiting: deque[tuple[Job, int]] = deque()
        self._tasks: dict[Any, _Task] = {}
        self._stopped = False
        # The first job compiles the kernels that Warp's cache lacks, which nodes may share; the others wait until it is
        # under way.
        self._fanned_out = False
        self._workers, self._surveyed = -1, -SURVEY_INTERVAL
        self._nodes: list[dict[str, Any]] = []
        # Of nodes that have the rest of what a job needs, the most memory, bytes.
        self._largest = -1.0
        # Why a node gets no jobs, by its id.
        self._shunned: dict[str, str] = {}
        with_gpu = device == "cuda:0" or (device == "auto" and ray.cluster_resources().get("GPU", 0) >= 1)
        self._device = "cuda:0" if with_gpu else "cpu"
        self._share = {"CPU": THREADS, **({"GPU": 1} if with_gpu else {})}
        # By value, so that a node without this package can say so.
        ray.cloudpickle.register_pickle_by_value(sys.modules[do_job.__module__])
        self._do_job = ray.remote(do_job)

    def is_busy(self) -> bool:
        """Say whether there is something to do or to wait for."""
        return bool(self._tasks or self._waiting)

    def take(self, jobs: Sequence[Job]) -> None:
        """Add jobs to those that wait."""
        self._waiting += [(job, 1) for job in jobs]

    def stop(self) -> None:
        """Interrupt what is under way, and begin nothing more."""
        self._stopped = True
        for reference in self._tasks:
            self._ray.cancel(reference, force=False)
        for job, attempt in self._waiting:
            self._tell("", Result(job.name, INTERRUPTED, "interrupted", attempt - 1))
        self._waiting.clear()

    def survey(self) -> None:
        """From time to time, see which nodes there are, and how far the jobs are."""
        if time.monotonic() < self._surveyed + SURVEY_INTERVAL:
            return
        self._surveyed = time.monotonic()
        self._nodes = [node for node in self._ray.nodes() if node["Alive"] and node["NodeID"] not in self._shunned]
        offers = [node["Resources"] for node in self._nodes]
        room = sum(int(min(offer.get(what, 0) / share for what, share in self._share.items())) for offer in offers)
        fitting = [offer for offer in offers if all(offer.get(what, 0) >= share for what, share in self._share.items())]
        self._largest = max((offer.get("memory", 0) for offer in fitting), default=-1.0)
        workers = room if self._limit is None else min(self._limit, room)
        if workers != self._workers:
            self._workers = workers
            _send(self._messages, Connected(workers))
        for reference, task in list(self._tasks.items()):
            if (done := _frames_under_way(task.job.folder)) is not None:
                self._fanned_out |= done > 0
                _send(self._messages, Progress(str(task.slot), task.job.name, done))
            if self._is_hopeless(task):
                self._ray.cancel(reference, force=True)
                del self._tasks[reference]
                self._give_up(str(task.slot), task.job, task.attempt)
                # What needs as much has waited as long.
                for job, attempt in list(self._waiting):
                    if job.memory_bytes >= task.job.memory_bytes:
                        self._waiting.remove((job, attempt))
                        self._give_up("", job, attempt)

    def _fits(self, job: Job) -> bool:
        """Say whether there is a node that is large enough for a job."""
        return job.memory_bytes <= self._largest

    def _is_hopeless(self, task: _Task) -> bool:
        """Say whether no node will ever take a job, as none has been large enough for some time."""
        if self._fits(task.job):
            task.misfit_since = None
            return False
        begins = task.misfit_since is None
        task.misfit_since = task.misfit_since or time.monotonic()
        if time.monotonic() >= task.misfit_since + self._patience or (self._shunned and not self._nodes):
            return True
        if begins:
            waits = f"{task.job.name} waits for a node, at most {self._patience / 60:.2g} minutes"
            _send(self._messages, Remark(f"{waits}: {self._why_not(task.job)}"))
        return False

    def _why_not(self, job: Job) -> str:
        """Say why no node takes a job."""
        told = "; ".join(self._shunned.values())
        if not self._nodes:
            return f"no node takes it: {told or 'the cluster has none'}"
        most = max(node["Resources"].get("memory", 0) for node in self._nodes)
        gpu = " and a GPU" if "GPU" in self._share else ""
        return (
            f"no node of the cluster is large enough: it needs {job.memory_bytes / 1e9:.2f} GB of memory{gpu}; the "
            f"largest node has {most / 1e9:.2f} GB" + (f" ({told})" if told else "")
        )

    def _give_up(self, worker: str, job: Job, attempts: int) -> None:
        self._tell(worker, Result(job.name, EnvironmentFailedError.exit_code, self._why_not(job), attempts))

    def _next(self) -> tuple[Job, int] | None:
        """Return what the cluster is to have next, if anything: no job that no node can take keeps others waiting.

        Of those it has one, the smallest, for which a cluster that grows may bring a node.
        """
        most = self._limit if self._limit is not None else QUEUED * max(1, self._workers)
        fitting = [self._fits(task.job) for task in self._tasks.values()]
        if sum(fitting) < (most if self._fanned_out else 1):
            found = next((waiting for waiting in self._waiting if self._fits(waiting[0])), None)
            if found is not None:
                return found
        misfits = [waiting for waiting in self._waiting if not self._fits(waiting[0])] if all(fitting) else []
        return min(misfits, key=lambda waiting: waiting[0].memory_bytes, default=None)

    def give_out(self) -> None:
        """Give the cluster as many jobs as it is to have."""
        while (chosen := self._next()) is not None:
            self._waiting.remove(chosen)
            job, attempt = chosen
            taken = {task.slot for task in self._tasks.values()}
            slot = next(number for number in itertools.count(1) if number not in taken)
            call = self._do_job.options(
                name=job.name,
                num_cpus=self._share["CPU"],
                num_gpus=self._share.get("GPU", 0),
                memory=min(job.memory_bytes, MOST_MEMORY),
                # Ray would begin it as the first time; we go on with it.
                max_retries=0,
                label_selector={_NODE_LABEL: f"!in({','.join(self._shunned)})"} if self._shunned else None,
            )
            reference = call.remote(
                pickle.dumps(job),
                batch=str(job.folder.parent),
                owner=(job.folder.parent / LOCK_NAME).read_text(encoding="ascii"),
                version=version_of("warpjelly"),
                device=self._device,
                threads=THREADS,
            )
            self._tasks[reference] = _Task(job, attempt, slot)

    def collect(self) -> None:
        """Take in what has ended."""
        if self._tasks:
            ended, _ = self._ray.wait(list(self._tasks), timeout=INTERVAL)
            for reference in ended:
                self._settle(self._tasks.pop(reference), reference)

    def _settle(self, task: _Task, reference: Any) -> None:
        """Say what came of a task, or have its job begun again."""
        self._fanned_out = True
        name, attempt, errors = task.job.name, task.attempt, self._ray.exceptions
        lost, result = None, Result(name, INTERRUPTED, "interrupted", attempt)
        not_begun = replace(result, attempts=attempt - 1)
        try:
            node, code, reason = self._ray.get(reference)
            if code is None:
                result = not_begun
                if not self._stopped:
                    self._shun(node, reason)
                    self._waiting.appendleft((task.job, attempt))
                    return
            elif code == INTERRUPTED:
                lost = _ENDED
            else:
                result = Result(name, code, reason, attempt)
        except errors.TaskCancelledError:
            lost, result = _ENDED, not_begun
        except errors.RayTaskError as error:
            why = f"internal error: {type(error.cause).__name__}: {' '.join(str(error.cause).split())}"
            result = Result(name, EnvironmentFailedError.exit_code, why, attempt)
        except errors.RayError as error:
            lost = _LOST.get(type(error).__name__) or f"Ray has lost it: {' '.join(str(error).split())}"
        if lost is not None and not self._stopped:
            if attempt < ATTEMPTS:
                self._waiting.appendleft((replace(task.job, resume=True), attempt + 1))
                return
            why = f"{lost}, {attempt} times in a row"
            result = Result(name, EnvironmentFailedError.exit_code, why, attempt)
        self._tell(str(task.slot), result)

    def _shun(self, node: str, reason: str) -> None:
        """Give a node no more jobs."""
        # It may have had several.
        if node not in self._shunned:
            self._shunned[node] = reason
            _send(self._messages, Remark(f"{reason}; it gets no more runs"))

    def _tell(self, worker: str, result: Result) -> None:
        _send(self._messages, Ended(worker, result))


def _frames_under_way(folder: Path) -> int | None:
    """Return how many frames a run has, None if no process writes to its directory."""
    if not (folder / LOCK_NAME).exists():
        return None
    try:
        with open(folder / METRICS_NAME, "rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL))
            row = file.read().split(b"\n")[-2]
        return int(row.partition(b",")[0]) + 1
    except (OSError, IndexError, ValueError):
        # Not there yet, or with a header only.
        return 0


def do_job(
    pickled: bytes, *, batch: str, owner: str, version: str, device: str, threads: int
) -> tuple[str, int | None, str | None]:
    """Do a job on a node of the cluster, in a process that Ray has made there.

    Args:
        pickled: the job, which cannot be read where this package is missing.
        batch: the folder of the batch.
        owner: what its lock says.
        version: of warpjelly where the batch is.
        device: where to simulate.
        threads: how many.

    Returns:
        The id of the node; the exit code, or None if this node cannot do it; and the reason.
    """
    import os
    import socket

    import ray

    node, host = ray.get_runtime_context().get_node_id(), f"node {socket.gethostname()}"
    os.environ.setdefault("PXR_WORK_THREAD_LIMIT", str(threads))
    try:
        from warpjelly.batch.rayjobs import attempt, sees
        from warpjelly.checkpoint import version_of
    except ImportError as error:
        return node, None, f"{host} has no warpjelly {version}: {error}"
    if (there := version_of("warpjelly")) != version:
        return node, None, f"{host} has warpjelly {there}, not {version}"
    if not sees(batch, owner):
        return node, None, f"{host} does not see {batch}, which has to be on a file system that all nodes share"
    return node, *attempt(pickled, device)


def attempt(pickled: bytes, device: str) -> tuple[int, str | None]:
    """Do a job in this process, and return exit code and reason."""
    try:
        job = pickle.loads(pickled)
        # That of a process which had it before ends with that process, and that of a lost node some time later.
        wait_for_lock(job.folder, LEASE)
    except Exception as error:
        why, code = verdict(error)
        return code, why
    result = perform(job, device=device, threads=THREADS)
    return result.exit_code, result.reason


def sees(folder: str, owner: str) -> bool:
    """Say whether a folder is the one whose lock somebody has, maybe on another machine."""
    for _ in range(SIGHT_ATTEMPTS):
        with suppress(OSError):
            if (Path(folder) / LOCK_NAME).read_text(encoding="ascii") == owner:
                return True
        time.sleep(1.0)
    return False
