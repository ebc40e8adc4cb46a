"""The web server: one page, the pieces of comparisons and the reports as files, all of it behind `Guard`."""

import logging
import socket
from collections.abc import Callable
from pathlib import Path

from fastapi import Request, Response
from fastapi.responses import FileResponse, HTMLResponse
from nicegui import app, ui

from tcbi_dashboard import page
from tcbi_dashboard.access import Guard, plain_page
from tcbi_dashboard.errors import DashboardError
from tcbi_dashboard.live import Live
from tcbi_dashboard.workbench import Workbench

log = logging.getLogger(__name__)
POLL_S = 0.2
LOOK_S = 3.0  # between two looks at the folders of rollouts
RECONNECT_S = 20.0  # for which a page that lost its connection finds its elements again
ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><path d="M3 5v23h26" fill="none" stroke="#7b838c" '
    'stroke-width="3"/><path d="M7 9c5 0 5 13 20 14" fill="none" stroke="#0072b2" stroke-width="4"/></svg>'
)


def serve(bench: Workbench, live: Live, show: bool = False, started: Callable[[], None] = lambda: None) -> None:
    """Serve until the process is told to end.

    Args:
      bench: what the page works on.
      live: the graph as the page sees it.
      show: open a browser.
      started: called once the page can be opened.

    Raises:
      DashboardError: the address cannot be used.
    """
    access = bench.access
    _check_free(access.host, access.port)
    app.add_middleware(Guard, access=access)
    _files(bench)
    page.build(bench, live)
    app.timer(POLL_S, lambda: _poll(bench))
    app.timer(LOOK_S, lambda: page.look(bench))
    app.on_startup(started)
    app.on_shutdown(bench.close)
    app.on_shutdown(live.close)
    ui.run(
        host=access.host,
        port=access.port,
        title="tcbi",
        favicon=ICON,
        dark=None,
        tailwind=False,
        show=show,
        reload=False,
        reconnect_timeout=RECONNECT_S,
        show_welcome_message=False,
    )


def _poll(bench: Workbench) -> None:
    """Take in what the jobs have said; what was recorded is offered wherever it lies."""
    bench.poll()
    recorded = bench.recording.job
    if recorded and recorded.result:
        bench.catalogue.include(Path(bag) for bag in recorded.result["bags"])


def _check_free(host: str, port: int) -> None:
    try:
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        with socket.socket(places[0][0], socket.SOCK_STREAM) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(places[0][4])
    except OSError as e:
        raise DashboardError(
            f"cannot listen on {host} port {port}: {e.strerror}; choose another --port, or an address of this machine"
        ) from e


def _files(bench: Workbench) -> None:
    runs = bench.store.root / "runs"

    @app.get("/data/{comparison}/{number}")
    def rollout(comparison: str, number: int) -> Response:
        return _file(runs, f"{comparison}/{number}.bin", "application/octet-stream")

    @app.get("/report/{name}")
    def report(name: str) -> Response:
        found = next((p for p in bench.reports() if p.name == name), None)
        return _file(found.parent, found.name, "text/html") if found else nothing(f"report {name}")

    @app.exception_handler(404)
    def elsewhere(request: Request, _: Exception) -> Response:
        return nothing(f"page {request.url.path}")


def nothing(what: str) -> Response:
    """The answer where there is nothing."""
    return HTMLResponse(plain_page(f"There is no {what} here.", link=True), status_code=404)


def _file(folder: Path, name: str, kind: str) -> Response:
    """A file inside a folder, and never one outside it."""
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()) or not path.is_file():
        return Response(status_code=404)
    return FileResponse(path, media_type=kind, headers={"Cache-Control": "no-cache"})
