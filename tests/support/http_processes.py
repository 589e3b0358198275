"""A REST API that is served by an HTTP process of its own while a test runs."""

import asyncio
import contextlib

from fog_runtime.http import HttpProcess


@contextlib.asynccontextmanager
async def running_http_process(make_app, folder, **options):
    """Serve what `make_app` makes, here and in its HTTP process; yield its address. It must end when cancelled."""
    port = folder / "port"
    task = asyncio.create_task(HttpProcess.fork(make_app, **options).serve(make_app(), port))
    try:
        async with asyncio.timeout(60):
            while not port.exists():
                assert not task.done()
                await asyncio.sleep(0.01)
        yield f"http://127.0.0.1:{int(port.read_text())}"
    finally:
        task.cancel()
        (ended,) = await asyncio.gather(task, return_exceptions=True)
    assert isinstance(ended, asyncio.CancelledError), ended
