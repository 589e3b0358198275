"""An operator's commands to a robot, and its states.

They go through the planner's REST API, which signs them for who has an operator's token. A stop goes by each way to the
robot, over its router, too, again and again, until one of them is through.
"""

import asyncio
import contextlib
import getpass
import http.client
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager
from queue import Empty, SimpleQueue
from typing import Any, Final

import msgspec

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.messages import CommandKind, Pose, RobotPath, RobotPose, RobotState
from fog_runtime import logs
from fog_runtime.clock import SystemClock
from fog_runtime.robot_commands import REPLY_TIMEOUT_S, RobotCommands
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav.operate.fog import Fog, Outcome, RefusedError, router
from fognav.output import FailedError, WrongUseError
from fognav.programs import PLANNER

STATE_TIMEOUT_S: Final = 3.0
"""Real seconds to wait for a robot's state, which comes once a second of its clock, and on change; at a simulated speed
below 1 as much longer."""
_PATHS: Final = 64


class Robot:
    """A robot of a running system: its latest state, pose and paths, and what stops it."""

    def __init__(self, edge: ZenohEdge, fog: Fog, robot: str, clock: SystemClock) -> None:
        self._edge = edge
        self._fog = fog
        self.clock = clock
        self.id = robot
        self._paths: deque[RobotPath] = deque(maxlen=_PATHS)
        self.state: RobotState | None = None
        self.pose: RobotPose | None = None
        self._changed = asyncio.Event()
        edge.subscribe(ch.ROBOT_STATE, RobotState, self._on_state, robot=robot)
        edge.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose, robot=robot)
        edge.subscribe(ch.ROBOT_PATH, RobotPath, self._on_path, robot=robot)

    def _on_state(self, _ids: Mapping[str, str], state: RobotState) -> None:
        self.state = state
        self._changed.set()

    def _on_pose(self, _ids: Mapping[str, str], pose: RobotPose) -> None:
        self.pose = pose

    def _on_path(self, _ids: Mapping[str, str], path: RobotPath) -> None:
        self._paths.append(path)

    def take_paths(self) -> list[RobotPath]:
        """Return the paths and refusals that the planner published since the last call, as far as they were kept."""
        taken = list(self._paths)
        self._paths.clear()
        return taken

    async def next_state(self) -> RobotState | None:
        """Return the next state that the robot publishes, or None when none comes in time."""
        self._changed.clear()
        try:
            async with asyncio.timeout(STATE_TIMEOUT_S / min(1.0, self.clock.speed)):
                await self._changed.wait()
        except TimeoutError:
            return None
        return self.state

    async def stop(self, kind: CommandKind = "disable", *, on_reply: Callable[[], None] | None = None) -> Outcome:
        """Send one of the commands that stop a robot, and need no signature.

        `on_reply` is called when the robot has replied, before its mode is waited for.
        Raises `FailedError` when the robot does not answer.
        """
        commands = RobotCommands(self._edge, operator=getpass.getuser(), key=None)
        try:
            # The timeout is in the clock's seconds, of which more pass in a fast simulation.
            timeout_s = REPLY_TIMEOUT_S * max(1.0, self.clock.speed)
            reply = await commands.send(kind, self.id, None, timeout_s=timeout_s)
        except ContractError as error:
            raise FailedError(f"robot {self.id} gave an invalid reply: {error}. Check that versions match") from error
        if reply is None:
            raise FailedError(
                f"robot {self.id} did not answer within {REPLY_TIMEOUT_S:.0f} s. Check its id, that its agent runs, "
                f"and that it is connected to {router(self._fog)}"
            )
        if on_reply is not None:
            on_reply()
        after = await self.next_state()
        return Outcome(
            accepted=reply.accepted,
            reason=reply.reason,
            mode=after.mode if after is not None else None,
            code=reply.code,
            causes=reply.causes,
        )


@asynccontextmanager
async def connect(fog: Fog, robot: str) -> AsyncIterator[Robot]:
    """Connect to a robot; raises `FailedError` when the router can't be reached."""
    clock = SystemClock(fog.system.speed)
    async with ZenohEdge.open(
        connect=[router(fog)], clock=clock, role="console", id=robot, site=fog.site, credentials=fog.credentials
    ) as edge:
        if not edge.connected:
            raise FailedError(f"the zenoh router {router(fog)} can't be reached: check that it runs (fognav status)")
        yield Robot(edge, fog, robot, clock)


def command(fog: Fog, robot: str, kind: CommandKind, pose: Pose | None = None) -> Outcome:
    """Let the planner sign and send a command; raises `FailedError` when it can't, or has no reply."""
    given = {} if pose is None else {"pose": msgspec.to_builtins(pose)}
    return _outcome(fog, robot, f"/api/v1/robots/{robot}/commands", {"kind": kind, **given})


def stop_by_planner(fog: Fog, robot: str) -> Outcome:
    """Stop a robot through the planner, which needs no token; raises `FailedError`."""
    return _outcome(fog, robot, f"/api/v1/robots/{robot}/stop", None)


def states(fog: Fog, robot: str) -> Iterator[Mapping[str, Any]]:
    """Yield the planner's view of a robot, now and whenever its state changes; raises `FailedError`."""
    path = f"/api/v1/robots/{robot}"
    view: Mapping[str, Any] = fog.get(PLANNER, path)
    while True:
        state = view["state"]
        if state is not None:
            yield view
        view = fog.get(PLANNER, f"{path}?after={state['clock'] if state is not None else 0.0}")


def _outcome(fog: Fog, robot: str, path: str, body: object) -> Outcome:
    try:
        answer = fog.send("POST", PLANNER, path, body)
    except RefusedError as error:
        if error.status != 409:
            raise
        problem = error.problem
        return Outcome(
            accepted=False,
            reason=error.reason,
            mode=problem.get("mode"),
            code=problem.get("refusal", ""),
            causes=problem.get("causes", []),
        )
    return Outcome(accepted=True, reason=answer["reason"], mode=_mode(fog, robot) or answer["mode"])


def _mode(fog: Fog, robot: str) -> Any:  # noqa: ANN401  # a mode, or None without a token that may read it
    if fog.token is None:
        return None
    try:
        state = fog.get(PLANNER, f"/api/v1/robots/{robot}")["state"]
    except FailedError:  # the robot has obeyed: a token that may not read changes nothing about that
        return None
    return state and state["mode"]


TELL_S: Final = 0.7
"""After this time an operator is told that the robot has not been reached yet: within a second, with its delays."""
GIVE_UP_S: Final = 60.0
RETRY_S: Final = 0.2
_HEAD_START_S: Final = 0.3
"""How long the direct way is tried alone: the planner is asked sooner only where that fails."""
_CLOSE_S: Final = 1.0
"""How long a session may take to close once the robot has been stopped by the other way."""
_LATER: Final = {http.client.REQUEST_TIMEOUT, http.client.TOO_EARLY, http.client.TOO_MANY_REQUESTS}
"""Refusals of now, not of the request."""

_Attempt = Callable[[], Outcome]


class _Replied(msgspec.Struct, frozen=True):
    """The robot has replied; only its mode is still waited for."""


def stop(fog: Fog, chosen: str | None, tell: Callable[[str], None]) -> Outcome:
    """Stop a robot (the chosen one, or the only one), directly or through the planner; neither needs key or token.

    While both ways fail they are tried again for `GIVE_UP_S`, and `tell` is given the reasons within a second.
    Raises `FailedError` then, or at once when the robot can't be reached directly and the planner refuses such a
    request for good; `WrongUseError` where there is a choice of robots.
    """
    logs.configure("fognav", "error", "text")
    return _Stop(fog, chosen, tell).run()


class _Stop:
    def __init__(self, fog: Fog, chosen: str | None, tell: Callable[[str], None]) -> None:
        self._fog = fog
        self._chosen = chosen
        self._tell = tell
        self._results: SimpleQueue[tuple[str, Outcome | _Replied | FailedError | WrongUseError]] = SimpleQueue()
        self._over = threading.Event()
        self._direct_failed = threading.Event()
        self._running: tuple[asyncio.AbstractEventLoop, asyncio.Task[Outcome]] | None = None

    def run(self) -> Outcome:
        # Threads that a hanging server holds must not hold the command: they end with it.
        direct = threading.Thread(target=self._keep_trying, args=("direct", self._direct), daemon=True)
        planner = threading.Thread(target=self._keep_trying, args=("planner", self._by_planner), daemon=True)
        direct.start()
        planner.start()
        try:
            return self._first()
        finally:
            self._over.set()
            if self._running is not None:
                loop, task = self._running
                with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
                    loop.call_soon_threadsafe(task.cancel)
            direct.join(_CLOSE_S)

    def _first(self) -> Outcome:
        """Return the first outcome of a way."""
        begun = time.monotonic()
        failures: dict[str, FailedError] = {}
        told = False
        while True:
            passed = time.monotonic() - begun
            try:
                way, result = self._results.get(timeout=max(0.0, (GIVE_UP_S if told else TELL_S) - passed))
            except Empty:
                if told:
                    raise FailedError(f"{self._name} is not known to have stopped: {_reasons(failures)}") from None
                told = True
                self._tell(
                    f"{self._name} is not known to have stopped yet: {_reasons(failures)}. Trying again for "
                    f"{GIVE_UP_S:.0f} s; Ctrl-C ends it"
                )
                continue
            if isinstance(result, Outcome):
                return result
            if isinstance(result, WrongUseError):
                raise result
            if isinstance(result, _Replied):
                told = True
                continue
            failures[way] = result
            if len(failures) > 1 and _for_good(failures["planner"]):
                raise FailedError(_reasons(failures))

    @property
    def _name(self) -> str:
        return "the robot" if self._chosen is None else f"robot {self._chosen}"

    def _keep_trying(self, way: str, attempt: _Attempt) -> None:
        if way == "planner":
            self._direct_failed.wait(_HEAD_START_S)
        while not self._over.is_set():
            try:
                outcome = attempt()
            except WrongUseError as error:
                self._results.put((way, error))
                return
            except asyncio.CancelledError:
                return
            except FailedError as error:
                self._results.put((way, error))
                if way == "direct":
                    self._direct_failed.set()
                elif _for_good(error):
                    return
            else:
                self._results.put((way, outcome))
                return
            self._over.wait(RETRY_S)

    def _by_planner(self) -> Outcome:
        return stop_by_planner(self._fog, self._robot())

    def _direct(self) -> Outcome:
        return asyncio.run(self._send(self._robot()))

    def _robot(self) -> str:
        try:
            return self._fog.robot(self._chosen)
        except RefusedError as error:  # a stop needs no token, but the list of robots does
            if error.status not in (http.client.UNAUTHORIZED, http.client.FORBIDDEN):
                raise
            raise WrongUseError(
                f"name the robot with --robot: then no token is needed. Without a name, {error}"
            ) from error

    async def _send(self, robot: str) -> Outcome:
        task = asyncio.current_task()
        assert task is not None
        self._running = asyncio.get_running_loop(), task
        try:
            async with connect(self._fog, robot) as connected:
                return await connected.stop(on_reply=self._replied)
        finally:
            self._running = None

    def _replied(self) -> None:
        self._results.put(("direct", _Replied()))


def _for_good(error: FailedError) -> bool:
    return isinstance(error, RefusedError) and 400 <= error.status < 500 and error.status not in _LATER


def _reasons(failures: dict[str, FailedError]) -> str:
    return "; ".join(str(failures[way]) for way in ("direct", "planner") if way in failures) or "nothing has answered"
