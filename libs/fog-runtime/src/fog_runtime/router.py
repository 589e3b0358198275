"""A zenoh router process: `python -m fog_runtime.router --listen tcp/127.0.0.1:7447`."""

import argparse
import asyncio
from collections.abc import Sequence

import zenoh

from fog_runtime import logs, process
from fog_runtime.zenoh_edge import session_config

_log = logs.get("router")


async def run_router(listen: Sequence[str], connect: Sequence[str] = ()) -> None:
    """Route between the clients of the endpoints `listen`, and those of the routers `connect`, until cancelled.

    Routers at `connect` need not be up yet. Raises `zenoh.ZError` if an endpoint of `listen` is taken.
    """
    session = await asyncio.to_thread(zenoh.open, session_config("router", listen=listen, connect=connect))
    try:
        _log.info("listening", endpoints=list(listen), zid=str(session.zid()))
        await asyncio.get_running_loop().create_future()
    finally:
        await asyncio.to_thread(session.close)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a router until SIGTERM."""
    parser = argparse.ArgumentParser(prog="fog_runtime.router", description="Run a zenoh router until SIGTERM.")
    parser.add_argument("--listen", action="append", required=True, metavar="tcp/ADDRESS:PORT")
    parser.add_argument(
        "--connect", action="append", default=[], metavar="tcp/ADDRESS:PORT", help="another router of the same site"
    )
    parser.add_argument("--log-level", default="info", choices=["debug", "info", "warning", "error"])
    parser.add_argument("--log-format", default="json", choices=["json", "text"])
    options = parser.parse_args(arguments)
    logs.configure("router", options.log_level, options.log_format)
    process.run(lambda: run_router(options.listen, options.connect))


if __name__ == "__main__":
    main()
