"""`foredrive serve`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import check_number
from foredrive.errors import InputError
from foredrive.lazy import importing


def serve(
    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    host: str = "127.0.0.1",
    port: int | None = None,
    protocol: Literal["neuro-ncap", "alpasim"] = "neuro-ncap",
) -> None:
    """Serve a run to another simulator, by neuro-ncap's protocols over HTTP or AlpaSim's over gRPC.

    A reconstruction is neuro-ncap's renderer server, with sweeps by named lidars; an agent is its model
    server, or a driver of AlpaSim. They run until Ctrl-C. docs/safety-tests.md has the requests.

    Args:
        run: Folder of a reconstruction, or an agent as for `foredrive drive`.
        host: Address at which it is served; use 0.0.0.0 to make it visible to other machines, which then may
            use it without a password.
        port: The port, 0 for any that is free; by default 8000 for a renderer and 9000 for an agent, as in
            neuro-ncap, and 50051 for a driver of AlpaSim.
        protocol: Whose protocol an agent speaks.
    """
    check_number("--port", port, low=0, high=65535)
    with importing():
        from foredrive.json_server import JsonServer
        from foredrive.runs.serve import alpasim_server_of, is_reconstruction, planner_of, renderer_of

    folder = Path(run)
    renders = is_reconstruction(folder)
    if protocol == "alpasim":
        if renders:
            raise InputError(f"{folder}: AlpaSim's renderer contract is not served; leave out --protocol")
        driver, bound = alpasim_server_of(run, host, 50051 if port is None else port)
        driver.start()
        try:
            print(f"{folder.name} is a driver at grpc://{host}:{bound} until you press Ctrl-C", flush=True)
            driver.wait_for_termination()
        finally:
            driver.stop(grace=1.0).wait()
        return
    answers = renderer_of(folder) if renders else planner_of(run)
    usual = 8000 if renders else 9000
    server = JsonServer(answers, host, usual if port is None else port)
    what = "renderer" if renders else "planner"
    print(f"{folder.name} is a {what} at http://{server.address} until you press Ctrl-C", flush=True)
    server.serve()
