"""`foredrive serve`."""

from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import check_number
from foredrive.lazy import importing


def serve(
    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    host: str = "127.0.0.1",
    port: int | None = None,
) -> None:
    """Serve a run to another simulator, by neuro-ncap's protocols over HTTP.

    A reconstruction is its renderer server, with sweeps by named lidars; an agent is its model server. Both
    run until Ctrl-C. docs/safety-tests.md has the requests.

    Args:
        run: Folder of a reconstruction, or an agent as for `foredrive drive`.
        host: Address at which it is served; use 0.0.0.0 to make it visible to other machines, which then may
            use it without a password.
        port: The port, 0 for any that is free; by default 8000 for a renderer and 9000 for an agent, as in
            neuro-ncap.
    """
    check_number("--port", port, low=0, high=65535)
    with importing():
        from foredrive.runs.serve import is_reconstruction, planner_of, renderer_of
        from foredrive.simulation.remote.json_http import JsonServer

    folder = Path(run)
    renders = is_reconstruction(folder)
    answers = renderer_of(folder) if renders else planner_of(run)
    usual = 8000 if renders else 9000
    server = JsonServer(answers, host, usual if port is None else port)
    try:
        what = "renderer" if renders else "planner"
        print(f"{folder.name} is a {what} at http://{server.address} until you press Ctrl-C", flush=True)
        server.serve()
    finally:
        server.close()
