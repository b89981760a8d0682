"""The cluster engine: Ray gives the jobs to its nodes; results land on a file system that all of them share."""

from __future__ import annotations

import os
import pickle
import queue
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

from ..errors import EnvironmentFailedError, InputError
from .jobs import Job, Result, Watcher, require_workers
from .rayjobs import OTHER_TOKEN, Connected, Ended, Progress, Refused, Remark

# How long a port may take to answer, and the cluster behind it, s.
PORT_PATIENCE, CLUSTER_PATIENCE = 5.0, 30.0
# How long a job may wait for a node that is large enough for it, s: clouds take minutes to bring one.
NODE_PATIENCE = 600.0
# How often the engine looks whether it is to stop, s.
INTERVAL = 0.1
# How long the process that speaks with Ray may take to let go of the cluster, s.
PATIENCE = 5.0
# What the address of a cluster stands in, unless it is given; and Ray's word for one that this machine is part of.
ADDRESS_VARIABLE, HERE = "RAY_ADDRESS", "auto"
# Starts the process that speaks with Ray, with the module path of this process.
_START = "import sys; sys.path[:] = {path!r}; from warpjelly.batch.rayjobs import drive; drive()"
# Of Ray, where the machine has a token: then `ray start --head` asks for it, too, but nothing else of Ray offers it.
_TOKEN_FILE = Path(".ray") / "auth_token"
_TOKEN = "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"


class RayEngine:
    """Does jobs on the nodes of a Ray cluster, of which this machine is one.

    Ray has a process of its own here. It writes to the terminal, takes over signals, tries for minutes to reach what is
    not there, and ends the process that it is in when the cluster goes.

    Args:
        address: HOST:PORT, as ``ray start --head`` says it; unless given, what ``RAY_ADDRESS`` says, or the cluster
            that this machine is part of.
        workers: how many jobs at a time; unless given, as many as the cluster has room for.
        device: "cpu"; "cuda:0", a GPU of the cluster for each job; or "auto", that where the cluster has GPUs.

    Raises:
        InputError: Ray is not installed, or the arguments are not sound.
    """

    name = "ray"

    def __init__(self, *, address: str | None = None, workers: int | None = None, device: str = "auto") -> None:
        if find_spec("ray") is None:
            raise InputError("the engine ray needs Ray: pip install 'warpjelly[cluster]'")
        require_workers(workers)
        if device not in ("auto", "cpu", "cuda:0"):
            raise InputError(f"device {device}: on a cluster Ray chooses the GPU; give auto, cpu or cuda:0")
        self.address = address or os.environ.get(ADDRESS_VARIABLE) or HERE
        self._host = None if self.address == HERE else _host_and_port(self.address)
        self.workers = workers or 0
        self._limit, self._device = workers, device
        self._link: _Link | None = None

    def __enter__(self) -> Self:
        """Connect to the cluster.

        Raises:
            InputError: this machine is not part of a cluster, and no address is given.
            EnvironmentFailedError: the cluster cannot be reached.
        """
        if self._host is not None:
            try:
                socket.create_connection(self._host, PORT_PATIENCE).close()
            except OSError as error:
                raise EnvironmentFailedError(
                    f"{self.address}: no Ray cluster there: {error.strerror or error}"
                ) from error
        self._link = _Link(self.address, self._limit, self._device)
        try:
            self.workers = self._link.connect()
        except BaseException:
            self._link.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Let go of the cluster, which ends what is still under way."""
        if self._link is not None:
            self._link.close()

    def run(self, jobs: Sequence[Job], *, watcher: Watcher, stopping: Callable[[], bool]) -> Iterator[Result]:
        """See ``Engine``. A job whose process or node is lost is begun again, from where it was."""
        assert self._link is not None
        waiting = {job.name: replace(job, folder=job.folder.absolute()) for job in jobs}
        self._link.send(list(waiting.values()))
        stopped = False
        while waiting:
            if stopping() and not stopped:
                stopped = True
                self._link.send(None)
            message = self._link.receive(INTERVAL)
            if isinstance(message, Progress):
                if message.name in waiting:
                    watcher.advance(message.worker, waiting[message.name], message.done)
            elif isinstance(message, Remark):
                watcher.say(message.text)
            elif isinstance(message, Connected):
                self.workers = message.workers
            elif isinstance(message, Ended):
                job = waiting.pop(message.result.name)
                if message.result.attempts:
                    watcher.end(message.worker, job, message.result)
                    yield message.result


def _host_and_port(address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    if not (colon and host and port.isdecimal() and "/" not in host):
        raise InputError(f"address {address}: give HOST:PORT, as 'ray start --head' says it, or {HERE}")
    return host.strip("[]"), int(port)


class _Link:
    """The process that speaks with Ray."""

    def __init__(self, address: str, limit: int | None, device: str) -> None:
        self._address = address
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._said = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            env={**os.environ, **_authentication()},
            # Ctrl-C is for this process, which tells that one.
            start_new_session=True,
        )
        threading.Thread(target=self._hear, daemon=True).start()
        self.send((address, limit, device, NODE_PATIENCE))

    def connect(self) -> int:
        """Wait for the cluster, and return how many jobs it does at a time.

        Raises:
            InputError: this machine is not part of a cluster.
            EnvironmentFailedError: the cluster did not answer, or refused us.
        """
        until = time.monotonic() + CLUSTER_PATIENCE
        while time.monotonic() < until:
            message = self.receive(INTERVAL)
            if isinstance(message, Connected):
                return message.workers
            if "InvalidAuthToken" in self._text():
                # Ray goes on trying.
                raise EnvironmentFailedError(f"{self._address}: {OTHER_TOKEN}")
        raise EnvironmentFailedError(
            f"{self._address}: no answer from a Ray cluster within {CLUSTER_PATIENCE:g} s; 'ray status' says whether "
            "one runs there"
        )

    def send(self, message: object) -> None:
        """Tell it something."""
        assert self._process.stdin is not None
        # If it is gone, that is what is heard of it next.
        with suppress(BrokenPipeError):
            pickle.dump(message, self._process.stdin)
            self._process.stdin.flush()

    def receive(self, timeout: float) -> Any:
        """Return the next message, None if there is none for so long [s].

        Raises:
            InputError: this machine is not part of a cluster.
            EnvironmentFailedError: the cluster is lost.
        """
        try:
            message = self._inbox.get(timeout=timeout)
        except queue.Empty:
            return None
        if isinstance(message, Refused):
            raise (InputError if message.exit_code == InputError.exit_code else EnvironmentFailedError)(message.reason)
        return message

    def close(self) -> None:
        """End it, which ends the jobs that it has under way."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._said.close()

    def _text(self) -> str:
        """Return what Ray said there."""
        size = os.fstat(self._said.fileno()).st_size
        return os.pread(self._said.fileno(), size, 0).decode(errors="replace")

    def _hear(self) -> None:
        """Put what the process says into the inbox."""
        assert self._process.stdout is not None
        with self._process.stdout as messages, suppress(EOFError, pickle.UnpicklingError):
            while True:
                self._inbox.put(pickle.load(messages))
        code = self._process.wait()
        with suppress(ValueError):
            said = next((line for line in reversed(self._text().splitlines()) if line.strip()), f"exit code {code}")
            # What comes first is when and where in Ray's source, and what comes last is advice to its developers.
            said = re.sub(r"^\[.*?\] \S+: ", "", said).partition(". ")[0]
            why = f"{self._address}: the connection to the Ray cluster is lost: {said}; go on with --resume"
            self._inbox.put(Refused(EnvironmentFailedError.exit_code, why))


def _authentication() -> dict[str, str]:
    """Return what has Ray offer the token that this machine has, unless it is told what to do."""
    if "RAY_AUTH_MODE" in os.environ:
        return {}
    has_token = any(name in os.environ for name in _TOKEN) or (Path.home() / _TOKEN_FILE).is_file()
    return {"RAY_AUTH_MODE": "token"} if has_token else {}
