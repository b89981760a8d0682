"""Choose the device that simulates."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from .errors import InputError

log = logging.getLogger("warpjelly")

# What Warp says at each start where no driver is installed.
NO_GPU = "Could not find or load the NVIDIA CUDA driver"


def start_warp() -> None:
    """Initialise Warp without a word on the terminal; what it says goes to the log."""
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    with _stderr_logged():
        wp.init()


def choose_device(name: str = "auto") -> str:
    """Return the Warp name of a device; "auto" is the first GPU, or the CPU where there is none.

    Raises:
        InputError: there is no such device.
    """
    start_warp()
    if name == "auto":
        return "cuda:0" if wp.is_cuda_available() else "cpu"
    known = [str(device) for device in wp.get_devices()]
    if name not in known:
        raise InputError(f"device {name}: not on this machine, which has {', '.join(known)}")
    return name


def gpus() -> list[str]:
    """Return the Warp names of all GPUs."""
    start_warp()
    return [str(device) for device in wp.get_cuda_devices()]


@contextmanager
def _stderr_logged() -> Iterator[None]:
    """Send what native code writes to stderr to the log."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file:
        stderr = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            file.seek(0)
            for line in file.read().decode(errors="replace").splitlines():
                # A machine without a GPU is nothing to warn of; a GPU that cannot be used is.
                log.log(logging.INFO if NO_GPU in line else logging.WARNING, "%s", line)
