"""The process that receives requests, so that requests delay the core as little as possible (ADR 24).

What it is worth: with 32 clients that ask for what costs most, the heartbeats (100 ms) of a map-service that received
requests itself had gaps of 257 ms (p99), and of 1,540 ms beside other work; with this process they have 124 ms on a
quiet machine, 154 ms at a load of 3. Robots slow down after 1 s.

It is forked from the core's process before that has threads and connections, and reads, checks and limits requests:
sizes, tokens, JSON, types. What is well-formed it passes on over a link; the core's process runs the route's handler on
its event loop, and returns the response.
"""

import asyncio
import contextlib
import gc
import hmac
import logging
import math
import os
import signal
import socket
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator, MutableMapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, NoReturn, Self

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

from fog_runtime import logs, machine
from fog_runtime.admission import BACKLOG, Admission, Visitor
from fog_runtime.credentials import ServerCertificate
from fog_runtime.files import write_port_file
from fog_runtime.http.link import CoreLink, HttpLink
from fog_runtime.http.routes import answer_call, rank_of

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]
Resolve = Callable[[str], Awaitable[set[str]]]

KNOWN_S: Final = 10.0
"""For how long an address is believed to be the gateway's."""
AGAIN_S: Final = 1.0
"""How soon the name is looked up again for somebody who is not the gateway."""
_HEADER: Final = b"x-forwarded-for"
_SCHEME: Final = b"x-forwarded-proto"
PROOF: Final = b"x-fognav-gateway"
"""The header by which the console-service, where it is the gateway, proves that (`Tokens.gateway_proof`)."""

MESSAGE_LIMIT: Final = 64 * 1024
"""Most bytes of a message that a client sends on a WebSocket."""

_log = logs.get("http")


async def addresses_of(name: str) -> set[str]:
    """Return the addresses of a name; none if it has none now."""
    try:
        found = await asyncio.get_running_loop().getaddrinfo(name, None, type=socket.SOCK_STREAM)
    except OSError:
        return set()
    return {str(address[0]) for *_, address in found}


class BehindGateway:
    """Gives the app the gateway's client instead of the gateway.

    Nobody but the gateway is believed, for others could pretend to be many clients, or another one. It is known by its
    name: in a network of containers its address changes with each start. The console-service has no address of its own
    where it is the gateway of this machine, and proves itself by the key of sessions.
    """

    def __init__(self, app: App, gateway: str, resolve: Resolve = addresses_of, *, proof: bytes = b"") -> None:
        """`gateway` is its name or address; `resolve` looks a name up. `proof` (if any) is as good as the address."""
        self._app = app
        self._gateway = gateway
        self._resolve = resolve
        self._proof = proof
        self._addresses: set[str] = set()
        self._looked_up = -math.inf

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
        peer = scope.get("client")
        named = _last(scope["headers"], _HEADER) if scope["type"] == "http" else ""
        if named and peer and (self._is_proven(scope["headers"]) or await self._is_gateway(peer[0])):
            scope = {**scope, "client": (named, 0)}
            if (scheme := _last(scope["headers"], _SCHEME)) in ("http", "https"):
                scope["scheme"] = scheme
        await self._app(scope, receive, send)

    def _is_proven(self, headers: Iterable[tuple[bytes, bytes]]) -> bool:
        sent = next((value for name, value in headers if name == PROOF), b"")
        return bool(self._proof) and hmac.compare_digest(sent, self._proof)

    async def _is_gateway(self, address: str) -> bool:
        if not self._gateway:
            return False
        age = asyncio.get_running_loop().time() - self._looked_up
        if age > (KNOWN_S if address in self._addresses else AGAIN_S):
            self._looked_up = asyncio.get_running_loop().time()
            self._addresses = await self._resolve(self._gateway)
        return address in self._addresses


def _last(headers: Iterable[tuple[bytes, bytes]], header: bytes) -> str:
    """Return what the gateway itself has seen: the last value, after those that the client claims."""
    values = [value for name, value in headers if name == header]
    return values[-1].decode("latin-1").rpartition(",")[2].strip() if values else ""


TRANSPORT: Final = "fognav.transport"
"""Where a request's scope has the connection's transport."""
NICENESS: Final = 5
"""The HTTP process gets a third of the processor time of a core that wants some, too."""
END_S: Final = 3.0
"""How long the HTTP process may take to end: open requests get 2 s."""
BETWEEN_REQUESTS_S: Final = 60.0
"""How long an answer may take to be sent, together with the next request."""
SAME_S: Final = 10.0
"""How often the server's own log repeats a line: whoever sends nonsense must not fill a disk."""


class _Unused:
    """Has every attribute, each of them the same again."""

    def __getattr__(self, name: str) -> Self:
        return self


def unused() -> Any:  # noqa: ANN401  # it stands for anything
    """Return a placeholder for what an app is made over but never uses: in an HTTP process, no handler is called."""
    return _Unused()


class HttpProcessError(Exception):
    """The process that receives requests has ended by itself."""


class HttpProcess:
    """The HTTP process as the core's process sees it."""

    def __init__(self, pid: int, link: socket.socket, scheme: str, host: str, port: int) -> None:
        """Use `HttpProcess.fork`."""
        self._pid = pid
        self._link = link
        self._scheme = scheme
        self._host = host
        self._port = port

    @classmethod
    def fork(
        cls,
        make_app: Callable[[], FastAPI],
        host: str = "127.0.0.1",
        port: int = 0,
        certificate: ServerCertificate | None = None,
        gateway: str = "",
    ) -> Self:
        """Fork the HTTP process, which accepts connections once `serve` runs; raises `OSError` when the port is taken.

        `make_app` is called there: the handlers of its routes are never called, and need nothing behind them. With a
        `certificate` it speaks HTTPS. The host `gateway`, and no other, is believed for whom it asks. Fork before this
        process has threads and connections. It ends with this process.
        """
        with _listener(host, port) as listener:
            ours, theirs = socket.socketpair()
            with theirs:
                pid = os.fork()
                if pid == 0:
                    _become_http_process(lambda: _behind(gateway, make_app()), listener, theirs, certificate)
            return cls(pid, ours, _scheme(certificate), host, int(listener.getsockname()[1]))

    async def serve(self, app: FastAPI, port_file: Path | None = None) -> None:
        """Answer what the HTTP process passes on with the routes of `app`, until cancelled.

        The port is logged as `listening` and written to `port_file`. Open requests get 2 s to end. Raises
        `HttpProcessError` when the HTTP process ends by itself.
        """
        link = await HttpLink.over(self._link)
        answering = asyncio.ensure_future(
            link.answer_calls(lambda route, data: answer_call(app, route, data), lambda route: rank_of(app, route))
        )
        try:
            await link.start()
            _log.info("listening", url=f"{self._scheme}://{self._host}:{self._port}", port=self._port)
            write_port_file(port_file, self._port)
            await asyncio.shield(answering)
            raise HttpProcessError("the process that receives requests has ended; its own log says why")
        finally:
            await link.stop()
            await asyncio.wait({answering}, timeout=END_S)
            link.close()
            answering.cancel()
            os.kill(self._pid, signal.SIGKILL)  # it has ended, or hangs
            await asyncio.to_thread(os.waitpid, self._pid, 0)


def _listener(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family, backlog=BACKLOG)


def _scheme(certificate: ServerCertificate | None) -> str:
    return "http" if certificate is None else "https"


async def serve_here(  # what `HttpProcess.fork` takes, too
    app: FastAPI,
    host: str = "127.0.0.1",
    port: int = 0,
    certificate: ServerCertificate | None = None,
    gateway: str = "",
    port_file: Path | None = None,
) -> None:
    """Serve an app in this process until cancelled, where no robot waits for what else the process does.

    Otherwise as `HttpProcess`. Raises `OSError` when the port is taken.
    """
    with _listener(host, port) as listener:
        machine.raise_limit()
        logging.getLogger("uvicorn.error").addFilter(_Sparing())
        server = _Server(_config(_behind(gateway, app), certificate))
        serving = asyncio.ensure_future(server.serve(sockets=[listener]))
        number = int(listener.getsockname()[1])
        _log.info("listening", url=f"{_scheme(certificate)}://{host}:{number}", port=number)
        write_port_file(port_file, number)
        try:
            await asyncio.shield(serving)
        finally:
            server.accept_no_more()
            server.should_exit = True
            await asyncio.wait({serving}, timeout=END_S)


def _behind(gateway: str, app: FastAPI) -> FastAPI:
    proof = app.state.tokens.gateway_proof
    if gateway or proof:
        app.add_middleware(BehindGateway, gateway=gateway, proof=proof)
    return app


class _Connection(H11Protocol):
    """A connection is a stranger's until a request is complete, and again once that is answered."""

    def __init__(self, visitor: Visitor, server: uvicorn.Server) -> None:
        super().__init__(server.config, server.server_state, server.lifespan.state)
        self._visitor = visitor
        if self.ws_protocol_class is not None:
            self.ws_protocol_class = partial(self.ws_protocol_class, visitor)  # type: ignore[assignment, call-arg]  # it is `sockets.Socket`, and only called

    def handle_events(self) -> None:
        super().handle_events()
        begun: RequestResponseCycle | None = self.cycle  # whatever uvicorn's own type says
        if begun is not None:
            begun.scope[TRANSPORT] = self.transport  # type: ignore[typeddict-unknown-key]  # ours, for what streams
        if begun is not None and not begun.more_body and not begun.response_complete:
            self._visitor.admit()

    def on_response_complete(self) -> None:
        answered = self.cycle
        super().on_response_complete()
        if self.cycle is answered:  # no further request was waiting
            self._visitor.estrange(BETWEEN_REQUESTS_S)

    def connection_lost(self, exc: Exception | None) -> None:
        self._visitor.left()
        super().connection_lost(exc)


class _Server(uvicorn.Server):
    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals alone: the HTTP process ends with the core's process."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept connections as `Admission` does, instead of as many as come."""
        await self.lifespan.startup()
        self.servers = []
        admission = Admission(lambda visitor: _Connection(visitor, self), self.config.ssl)
        self._accepting = asyncio.create_task(admission.serve(sockets or []))
        self.started = True

    def accept_no_more(self) -> None:
        """Leave the listening socket alone."""
        if self.started:
            self._accepting.cancel()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept no more connections, and let open requests end."""
        self.accept_no_more()
        await super().shutdown(sockets)


class _Sparing(logging.Filter):
    """Passes a message on once in `SAME_S`, with the number of those before that it did not."""

    def __init__(self) -> None:
        super().__init__()
        self._next: dict[str, float] = {}
        self._left_out: Counter[str] = Counter()

    def filter(self, record: logging.LogRecord) -> bool:
        now, text = time.monotonic(), str(record.msg)
        if now < self._next.get(text, 0.0):
            self._left_out[text] += 1
            return False
        self._next[text] = now + SAME_S
        if before := self._left_out.pop(text, 0):
            record.msg = f"{text} ({before} more before)"
        return True


def _become_http_process(
    make_app: Callable[[], FastAPI],
    listener: socket.socket,
    link: socket.socket,
    certificate: ServerCertificate | None,
) -> NoReturn:
    """Run the HTTP process in a forked child, and end the process."""
    status = 1
    try:
        signal.set_wakeup_fd(-1)  # the parent's loop listens at its other end
        for number in machine.ending():
            signal.signal(number, signal.SIG_IGN)
        _leave_files({listener.fileno(), link.fileno()})
        gc.freeze()  # shared with the parent until one of them writes
        os.nice(NICENESS)
        asyncio.run(_receive(make_app(), listener, link, certificate))
        status = 0
    except Exception as error:  # noqa: BLE001  # the last place that can log why it ends
        _log.error("http_process_crashed", error=error)
    finally:
        os._exit(status)


def _leave_files(kept: Collection[int]) -> None:
    """Let go of the parent's open files and sockets; their numbers stay in use, as objects here may close them."""
    null = os.open(os.devnull, os.O_RDWR)
    for path in list(Path("/proc/self/fd").iterdir()):
        number = int(path.name)
        if number > 2 and number not in kept and number != null:
            with contextlib.suppress(OSError):
                os.fstat(number)  # that of the listing itself is closed again
                os.dup2(null, number)


def _config(app: FastAPI, certificate: ServerCertificate | None) -> uvicorn.Config:
    sockets: Any = "none"
    if app.state.sockets:
        from fog_runtime.http.sockets import Socket as sockets  # noqa: N813, PLC0415  # an extra
    return uvicorn.Config(
        app,
        ws=sockets,
        ws_max_size=MESSAGE_LIMIT,
        log_config=None,
        access_log=False,
        lifespan="off",
        timeout_graceful_shutdown=2,
        server_header=False,
        proxy_headers=False,  # it would believe everybody on this computer
        ssl_certfile=None if certificate is None else certificate.file,
        ssl_keyfile=None if certificate is None else certificate.key,
    )


async def _receive(
    app: FastAPI, listener: socket.socket, end: socket.socket, certificate: ServerCertificate | None
) -> None:
    """Serve, once started, until the core's process stops this or ends."""
    link = await CoreLink.over(end)
    if not await link.started():
        return
    app.state.core = link
    machine.raise_limit()
    logging.getLogger("uvicorn.error").addFilter(_Sparing())
    server = _Server(_config(app, certificate))

    def stop() -> None:
        server.should_exit = True

    linked = asyncio.ensure_future(link.run(stop))
    serving = asyncio.ensure_future(server.serve(sockets=[listener]))
    done, _ = await asyncio.wait({linked, serving}, return_when=asyncio.FIRST_COMPLETED)
    if linked in done:
        server.accept_no_more()
        listener.close()  # at once: the service is started again on this port
        stop()  # open requests are still answered: their calls have failed
        await asyncio.wait({serving}, timeout=END_S)
    for task in done:
        task.result()
