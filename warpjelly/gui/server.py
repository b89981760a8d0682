"""The server of the page: on which address, for how long."""

from __future__ import annotations

import contextlib
import io
import socket
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ..errors import EnvironmentFailedError, InputError
from ..scene import Scene
from ..signals import interruptions

LOCAL = "127.0.0.1"
# Names of this machine that nobody else can give to one of his.
_LOCAL_NAMES = (LOCAL, "::1", "localhost")
# Where a page is looked for first, if no port is asked for.
USUAL_PORT = 8080


def require_viser() -> Any:
    """Return viser.

    Raises:
        InputError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError("the page needs one more package: pip install 'warpjelly[gui]'") from error
    return viser


def serve(
    scene: Scene | None,
    *,
    device: str = "auto",
    host: str = LOCAL,
    port: int | None = None,
    scenes: Path,
    folder: Path,
    open_page: bool = True,
) -> None:
    """Let people experiment with a scene in their browsers, until Ctrl-C.

    Args:
        scene: what to begin with; a cube over a floor unless given.
        device: see ``Session``.
        host: address to listen at.
        port: of it; the usual one if it is free, or any, unless given.
        scenes: folder with scenes to open.
        folder: where scenes, runs and models from browsers are written to.
        open_page: whether to open the page in a browser here.

    Raises:
        InputError: viser is missing, or the scene cannot be built.
        EnvironmentFailedError: the address cannot be listened at.
    """
    require_viser()
    from .session import Session

    with interruptions() as interrupted, Session(scene, device=device) as session:
        with served(session, host=host, port=port, scenes=scenes, folder=folder) as (page, address):
            print(f"page: {address}  (Ctrl-C ends it)", flush=True)
            if host not in _LOCAL_NAMES:
                print(
                    "warning: whoever reaches this address can change the simulation, and write scenes, models and "
                    f"runs into {folder}: there is no password",
                    flush=True,
                )
            if open_page:
                webbrowser.open(address)
            while not interrupted() and page.failure is None:
                time.sleep(0.1)
            if page.failure is not None:
                raise page.failure


@contextmanager
def served(
    session: Any, *, host: str = LOCAL, port: int | None = None, scenes: Path, folder: Path
) -> Iterator[tuple[Any, str]]:
    """Serve the page of a session; see ``serve``. Gives the page and its address."""
    viser = require_viser()
    from .page import Page

    with _quiet(), _own_page_only(host):
        server = viser.ViserServer(host=host, port=_free_port(host, port), verbose=False)
    try:
        # If somebody was faster viser took the next one.
        chosen = server.get_port()
        if port not in (None, chosen):
            raise EnvironmentFailedError(_taken(host, port))
        # Browsers may ask viser for an address that is reached from anywhere; here they do not get one.
        server.request_share_url = lambda verbose=True: None
        page = Page(server, session, scenes=scenes, folder=folder)
        try:
            shown = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
            yield page, f"http://{shown}:{chosen}"
        finally:
            page.close()
    finally:
        with _quiet():
            server.stop()


def _free_port(host: str, port: int | None) -> int:
    """Return a port that can be listened at; viser itself would take the next free one and not say so."""
    try:
        family = socket.getaddrinfo(host, None)[0][0]
    except socket.gaierror as error:
        raise InputError(f"--host {host}: no address of this machine ({error.strerror})") from error
    for wanted in [USUAL_PORT, 0] if port is None else [port]:
        try:
            with socket.create_server((host, wanted), family=family) as listening:
                return int(listening.getsockname()[1])
        except OSError as error:
            failure = error
    raise EnvironmentFailedError(f"{_taken(host, port or 0)} ({failure.strerror})")


def _taken(host: str, port: int) -> str:
    return f"cannot listen at {host}:{port}; choose another --port, or leave it out"


@contextmanager
def _own_page_only(host: str) -> Iterator[None]:
    """Let servers of viser that are started in the block refuse connections from pages of other sites.

    A browser lets any page connect to this machine, and says which site it is of. That has to be the one it connects
    to; and where only this machine is listened to, one of its names, as others may be given the same address.
    """
    from websockets.asyncio import server

    module: Any = server
    serve = module.serve

    def serve_own(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            # Who is no browser says nothing.
            if (origin := request.headers.get("Origin")) is not None:
                site = urlsplit(origin)
                known = host not in _LOCAL_NAMES or site.hostname in _LOCAL_NAMES
                if not known or site.netloc != request.headers.get("Host"):
                    return connection.respond(HTTPStatus.FORBIDDEN, "another site's page may not connect\n")
            return process_request(connection, request)

        return serve(*arguments, process_request=process, **options)

    module.serve = serve_own
    try:
        yield
    finally:
        module.serve = serve


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what viser prints of itself off the terminal."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
