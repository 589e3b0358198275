"""The viewers of a floor: who they are, what each wants, and what each has not been sent yet.

Of each channel a viewer is owed the latest message only. So a slow one costs a message per channel, whatever happens,
and slows nobody.
"""

from __future__ import annotations

import asyncio
import re
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Final
from uuid import uuid4

from starlette.websockets import WebSocket, WebSocketDisconnect

from fog_bridges.floor import REFUSED
from fog_bridges.foxglove.protocol import (
    SUBPROTOCOLS,
    Channel,
    GetParameters,
    ProtocolError,
    Request,
    Schema,
    Subscribe,
    advertised,
    message_data,
    parameter_values,
    parsed,
    server_info,
    warning,
)
from fog_runtime import logs
from fog_runtime.http.problems import RETRY_AFTER, HttpProblem, problem
from fog_runtime.token_file import ROLES

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from starlette.responses import Response

    from fog_bridges.floor import Floor
    from fog_bridges.foxglove.protocol import Value

ROUTE: Final = "/api/v1/foxglove"
ROLE: Final = "viewer"
VIEWERS: Final = 8
"""Most viewers at the same time."""
ASKING: Final = 4
"""So many who want to look on are looked up at the same time: the console answers orders and stops, too."""
SUBSCRIPTIONS: Final = 1000
"""Most subscriptions of a viewer."""
OWED: Final = 100
"""Most texts that a viewer may be owed; one that goes on to ask without reading is disconnected."""
ADMITTED_S: Final = 10.0
"""How often it is asked whether a viewer's token is still one."""
CLOSE_S: Final = 1.0
_TOKEN: Final = re.compile(r"[!-~]{1,200}")
_ADMITTED: Final = ROLES[ROLES.index(ROLE) :]
_POLICY: Final = 1008
"""The status of RFC 6455 for who may not stay."""
_log = logs.get("foxglove")


class Post:
    """A message, encoded when the first viewer gets it."""

    def __init__(self, make: Callable[[], bytes], stamp: float) -> None:
        """`stamp` (s since 1970) is when it was true."""
        self.stamp = stamp
        self._make = make
        self._data: bytes | None = None

    @property
    def data(self) -> bytes:
        """The encoded message."""
        if self._data is None:
            self._data = self._make()
        return self._data


class Viewer:
    """What one viewer wants and is owed."""

    def __init__(self) -> None:
        """Begin without any subscription."""
        self._wanted: dict[int, int] = {}
        """The channel of each subscription."""
        self._texts: deque[str] = deque()
        self._posts: dict[int, Post] = {}
        """The message that each subscription is owed, the one that waits longest first."""
        self._news = asyncio.Event()

    @property
    def reads(self) -> bool:
        """Whether it reads the answers to what it asks."""
        return len(self._texts) < OWED

    def subscribe(self, subscription: int, channel: int, latest: Post | None) -> None:
        """Want a channel, and its latest message at once; raises `ProtocolError`."""
        if any(wanted == channel for number, wanted in self._wanted.items() if number != subscription):
            raise ProtocolError(f"channel {channel} is subscribed already: each message is sent once")
        if subscription not in self._wanted and len(self._wanted) >= SUBSCRIPTIONS:
            raise ProtocolError(f"{SUBSCRIPTIONS} subscriptions are there already: end some")
        self._wanted[subscription] = channel
        if latest is not None:
            self._owe(subscription, latest)

    def unsubscribe(self, subscription: int) -> None:
        """Want no more of a subscription."""
        self._wanted.pop(subscription, None)
        self._posts.pop(subscription, None)

    def tell(self, text: str) -> None:
        """Owe a text."""
        self._texts.append(text)
        self._news.set()

    def post(self, channel: int, post: Post) -> None:
        """Owe a message in place of the one before, if the channel is wanted."""
        for subscription, wanted in self._wanted.items():
            if wanted == channel:
                self._owe(subscription, post)

    def _owe(self, subscription: int, post: Post) -> None:
        self._posts[subscription] = post
        self._news.set()

    async def send_all(self, socket: WebSocket) -> None:
        """Send what is owed, one after the other, for as long as the viewer takes it. Never returns."""
        while True:
            await self._news.wait()
            self._news.clear()
            while self._texts or self._posts:
                if self._texts:
                    await socket.send_text(self._texts.popleft())
                else:
                    subscription = next(iter(self._posts))
                    post = self._posts.pop(subscription)
                    await socket.send_bytes(message_data(subscription, post.stamp, post.data))


class Viewers:
    """All viewers, and the latest message of each channel."""

    def __init__(self, name: str, parameters: Callable[[], Mapping[str, Value]]) -> None:
        """`name` is what viewers see; `parameters` are read anew for each who asks."""
        self._name = name
        self._parameters = parameters
        self._session = uuid4().hex
        self._channels: dict[str, Channel] = {}
        self._latest: dict[int, Post] = {}
        self._viewers: set[Viewer] = set()
        self._places = self._asking = 0
        self._limited = logs.RateLimited(_log)
        self.floor: Floor | None = None
        """Who says which role a token has; None: nobody yet."""

    def post(self, topic: str, encoding: str, schema: Schema, make: Callable[[], bytes], stamp: float) -> None:
        """Show a message on a topic, in place of the one before; it is made only if somebody gets it."""
        if topic not in self._channels:
            channel = self._channels[topic] = Channel(len(self._channels) + 1, topic, encoding, schema)
            for viewer in self._viewers:
                viewer.tell(advertised([channel]))
        number = self._channels[topic].id
        post = self._latest[number] = Post(make, stamp)
        for viewer in self._viewers:
            viewer.post(number, post)

    async def serve(self, socket: WebSocket) -> None:
        """Serve a viewer until it leaves, or its token is revoked."""
        token = _token(socket)
        if (refusal := await self._refusal(socket, token)) is not None:
            REFUSED.labels("foxglove", "refused").inc()
            await socket.send_denial_response(refusal)
            return
        self._places += 1
        try:
            await socket.accept(next(each for each in SUBPROTOCOLS if each in socket.scope["subprotocols"]))
            await self._serve(socket, token)
        except WebSocketDisconnect:
            pass  # it has left
        finally:
            self._places -= 1

    async def _serve(self, socket: WebSocket, token: str) -> None:
        viewer = Viewer()
        viewer.tell(server_info(self._name, self._session))
        viewer.tell(advertised(list(self._channels.values())))
        self._viewers.add(viewer)
        tasks = {
            asyncio.ensure_future(each)
            for each in (viewer.send_all(socket), self._receive_all(socket, viewer), self._admitted(token))
        }
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            ended = next(iter(done))
            if (error := ended.exception()) is not None:
                raise error
            if reason := str(ended.result() or ""):
                with suppress(TimeoutError):  # who does not read does not take this either
                    await asyncio.wait_for(socket.close(_POLICY, reason), CLOSE_S)
        finally:
            self._viewers.discard(viewer)
            for each in tasks:
                each.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _receive_all(self, socket: WebSocket, viewer: Viewer) -> str:
        """Do what a viewer asks for; return why it must leave, empty when it has left."""
        while (message := await socket.receive())["type"] == "websocket.receive":
            text = message.get("text")
            try:
                self._do(viewer, parsed(message["bytes"] if text is None else text))
            except ProtocolError as error:
                REFUSED.labels("foxglove", "malformed").inc()
                self._limited.warning("message_refused", "", asyncio.get_running_loop().time(), reason=str(error))
                viewer.tell(warning(str(error)))
            await asyncio.sleep(0)  # what is owed is sent meanwhile, also if many requests came at once
            if not viewer.reads:
                return f"{OWED} answers wait to be read"
        return ""

    def _do(self, viewer: Viewer, request: Request) -> None:
        if isinstance(request, GetParameters):
            viewer.tell(parameter_values(self._parameters(), request))
        elif isinstance(request, Subscribe):
            known = {channel.id for channel in self._channels.values()}
            for each in request.subscriptions:
                if each.channelId not in known:
                    raise ProtocolError(f"there is no channel {each.channelId}")
                viewer.subscribe(each.id, each.channelId, self._latest.get(each.channelId))
        else:
            for number in request.subscriptionIds:
                viewer.unsubscribe(number)

    async def _refusal(self, socket: WebSocket, token: str) -> Response | None:
        """Return why somebody is no viewer, None for one who is."""
        offered = socket.scope["subprotocols"]
        if not any(each in offered for each in SUBPROTOCOLS):
            detail = f"ask for one of the subprotocols {', '.join(SUBPROTOCOLS)}: Foxglove does"
            return problem(HttpProblem.REQUEST_INVALID, detail)
        if not token:
            detail = f"send `Authorization: Bearer TOKEN`, or from Foxglove's app open {ROUTE}?token=TOKEN"
            return problem(HttpProblem.TOKEN_MISSING, detail)
        if self._asking >= ASKING:
            return problem(HttpProblem.OVERLOADED, "others are being looked up", headers=RETRY_AFTER)
        self._asking += 1
        try:
            role = await self.floor.role_of(token) if self.floor is not None and _TOKEN.fullmatch(token) else ""
        finally:
            self._asking -= 1
        if self._places >= VIEWERS:
            detail = f"{VIEWERS} viewers look on already: close one"
            return problem(HttpProblem.OVERLOADED, detail, headers=RETRY_AFTER)
        return _refusal_of(role, in_address="token" in socket.query_params)

    async def _admitted(self, token: str) -> str:
        """Return, once a viewer's token is none any more, that."""
        while True:
            await asyncio.sleep(ADMITTED_S)
            role = await self.floor.role_of(token) if self.floor is not None else None
            if role is not None and role not in _ADMITTED:  # a console that does not answer decides nothing
                return "the token was revoked"


def _refusal_of(role: str | None, *, in_address: bool) -> Response | None:
    """Return why a role may not look on; None: it may. A token in an address may do nothing else."""
    if role is None:
        detail = "the console does not say whose token this is: try again once it runs"
        return problem(HttpProblem.RESTARTED, detail, headers=RETRY_AFTER)
    if not role:
        return problem(HttpProblem.TOKEN_UNKNOWN, "the token is unknown: use one of the site's tokens")
    if role not in _ADMITTED:
        return problem(HttpProblem.ROLE_TOO_LOW, f"this needs the role {ROLE}, and the token has the role {role}")
    if in_address and role != ROLE:
        detail = (
            f"an address is kept where others may read it, and this token may do more than look ({role}): make one "
            f"for Foxglove, `fognav token create foxglove --role {ROLE}`"
        )
        return problem(HttpProblem.ROLE_TOO_LOW, detail)
    return None


def _token(socket: WebSocket) -> str:
    """Return the token of a request: in its header or, as browsers can't send one, in its address."""
    scheme, _, token = socket.headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else socket.query_params.get("token", "")
