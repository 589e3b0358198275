"""`fognav docs`: the documentation as a site."""

import contextlib
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from fognav import checkout
from fognav.output import FailedError, exit_codes, print_line


@exit_codes()
def docs_command(
    *,
    serve: Annotated[
        bool, typer.Option("--serve", help="Show it on this machine until Ctrl-C, and documents as they change.")
    ] = False,
    port: Annotated[int, typer.Option("--port", min=1, max=65535, help="Port of --serve.")] = 8000,
) -> None:
    """Build the documentation as a site, and check its links.

    The first time this installs what builds it. The site is in .fognav/docs/site, and loads nothing from elsewhere.
    """
    from fognav import documentation, generated  # noqa: PLC0415  # keeps the other commands fast

    root = checkout.root()
    folder = root / ".fognav" / "docs"
    if (builder := documentation.find_builder(root)) is None:
        print_line("installing what builds the documentation (once)")
        builder = documentation.install_builder(root)
    started = time.monotonic()
    routes = generated.rest_routes()
    documentation.write(root, folder, routes)
    if wrong := documentation.build(builder, folder):
        raise FailedError(f"{wrong}\ncorrect the documents named above")
    pages = sum(1 for _ in (folder / "site").rglob("*.html"))
    print_line(f"built {pages} pages in {time.monotonic() - started:.0f} s: {folder / 'site' / 'index.html'}")
    if serve:
        _serve(builder, folder, port, lambda: documentation.write(root, folder, routes))


def _serve(builder: Path, folder: Path, port: int, update: Callable[[], None]) -> None:
    """Show the site; the program builds anew what changes in its folder."""
    with subprocess.Popen([builder, "serve", "--dev-addr", f"127.0.0.1:{port}"], cwd=folder) as server:
        try:
            while server.poll() is None:
                update()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    server.wait(1.0)
        except KeyboardInterrupt:
            server.terminate()
