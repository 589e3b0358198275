"""Operators' commands to robots, for callers without a key: signed here, recorded, answered by the robot itself.

The planner's leader is the only service that signs (ADR 31). It keeps no command: one that did not reach its
robot must be sent again by a person.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec
from prometheus_client import Gauge

from fog_contracts.codec import ContractError
from fog_contracts.commands import STOPS
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.robot_commands import REPLY_TIMEOUT_S, RobotCommands
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Audit

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from fog_contracts.messages import CommandKind, CommandReply, HandOver, Pose, RobotState
    from fog_runtime.clock import Clock
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from planner.store import Store
    from planner.tours.persistence import MissionPersistence

RETURNS: Final = 3
"""How often the states must change back to an earlier run: a late one after a restart changes back to it, and again."""
REMEMBERED_S: Final = 10.0
"""How long a run, and what was found, are remembered after they were last heard."""

_log = logs.get("planner")


@dataclass
class _Runs:
    current: str = ""
    heard_at: dict[str, float] = field(default_factory=dict)
    returns: int = 0
    found_at: float | None = None


class DoubledRobots:
    """Robots whose id two agents use at the same time, as when a memory card was copied.

    Both would follow every path and goal of that id, each from where the other one stands. They are found by their
    states: each run of an agent has an id of its own (`boot`), and never comes back.
    """

    def __init__(self) -> None:
        self._runs: dict[str, _Runs] = {}

    def on_state(self, robot: str, boot: str, now: float) -> bool:
        """Handle a state of the agent run `boot`, at `now` (s, monotonic); return whether the robot is a new find."""
        if not boot:
            return False
        runs = self._runs.setdefault(robot, _Runs())
        runs.heard_at = {run: at for run, at in runs.heard_at.items() if now - at <= REMEMBERED_S}
        if len(runs.heard_at) <= 1:
            runs.returns = 0
        new = False
        if boot != runs.current and boot in runs.heard_at:
            runs.returns += 1
            if runs.returns >= RETURNS:
                new, runs.found_at = not self.is_doubled(robot, now), now
        runs.current = boot
        runs.heard_at[boot] = now
        return new

    def is_doubled(self, robot: str, now: float) -> bool:
        """Whether two agents use this id now."""
        runs = self._runs.get(robot)
        return runs is not None and runs.found_at is not None and now - runs.found_at <= REMEMBERED_S

    def found(self, now: float) -> list[str]:
        """Return the ids that two agents use now, sorted."""
        return sorted(robot for robot in self._runs if self.is_doubled(robot, now))


PERIOD_S: Final = 600.0
"""How long repeated stops of a robot are counted before an entry tells of them."""
SENDERS: Final = 4
"""How many senders have entries of their own, for each robot and period; all others are counted together."""
OTHERS: Final = "others"


@dataclass
class _Period:
    begun_at: float
    senders: set[str] = field(default_factory=set)
    repeats: Counter[str] = field(default_factory=Counter)


class StopRecords:
    """Which stops are recorded one by one, and which are only counted.

    Anybody may stop a robot, as often as they like. So that nobody can push the rest out of the audit trail by that,
    only the first stop of each sender is an entry of its own, for some senders; what they repeat is counted, and one
    entry per robot and period tells how often. Of who may command robots each stop is an entry, but for those of a
    robot that they have stopped already.
    """

    def __init__(self) -> None:
        self._periods: dict[str, _Period] = {}

    def count(self, robot: str, sender: str, now: float, *, always: bool = False) -> bool:
        """Count a stop at `now` (s, monotonic); return whether it is to be recorded by itself, as with `always`."""
        period = self._periods.setdefault(robot, _Period(now))
        if sender not in period.senders and len(period.senders) < SENDERS:
            period.senders.add(sender)
        elif not always:
            self.unrecorded(robot, sender, now)
            return False
        return True

    def unrecorded(self, robot: str, sender: str, now: float) -> None:
        """Count a stop at `now` that has no entry of its own: it is a repetition, or could not be recorded."""
        period = self._periods.setdefault(robot, _Period(now))
        period.repeats[sender if sender in period.senders else OTHERS] += 1

    def due(self, now: float) -> dict[str, Mapping[str, int]]:
        """Return, for each robot whose period is over, how often each sender repeated a stop; may be called again."""
        due: dict[str, Mapping[str, int]] = {}
        for robot, period in list(self._periods.items()):
            if now - period.begun_at < PERIOD_S:
                continue
            if period.repeats:
                due[robot] = dict(period.repeats)
            else:
                del self._periods[robot]
        return due

    def recorded(self, robot: str, repeats: Mapping[str, int], now: float) -> None:
        """Begin the next period of a robot whose repeated stops, as returned by `due`, are recorded now.

        Who repeated them is known, and gets no entry of its own again while going on.
        """
        period = self._periods[robot]
        later = period.repeats - Counter(repeats)
        self._periods[robot] = _Period(now, period.senders & {*repeats, *later}, later)


STATE_MAX_AGE_S: Final = 3.0
"""A command names the robot's clock by its latest state, which comes once a second."""

_RECORDS_PERIOD_S: Final = 10.0

DOUBLED = Gauge("fognav_planner_robots_doubled", "Robots whose id two agents use; nothing is planned for them")


class CommandError(Exception):
    """A command did not reach its robot, or its reply did not come back; the message names the remedy."""


class RobotOperator:
    """Commands one site's robots with its operators' key; without a key it only stops them."""

    def __init__(self, zenoh: ZenohEdge, store: Store, clock: Clock, key: bytes | None) -> None:
        self._zenoh = zenoh
        self._store = store
        self._clock = clock
        self._key = key
        self._states: dict[str, tuple[RobotState, float]] = {}
        self._changed: dict[str, asyncio.Event] = {}
        self._stops = StopRecords()
        self._limited = logs.RateLimited(_log)
        self._stopped_by: dict[str, set[str]] = {}
        """Who may command robots and has stopped one that was not enabled since."""
        self._doubled = DoubledRobots()
        self.stopped_at = -math.inf
        """When anybody last stopped robots (s, monotonic), but by a command of an operator."""
        self.overruled: Callable[[str], object] = lambda _robot: None
        """Called for a robot that somebody commands or stops, before the robot hears of it."""

    def on_state(self, robot: str, state: RobotState, now: float) -> None:
        """Record a robot's state, which arrived at `now` (s, monotonic)."""
        self._states[robot] = state, now
        if state.enabled:
            self._stopped_by.pop(robot, None)
        if self._doubled.on_state(robot, state.boot, now):
            _log.error(
                "robot_doubled", robot=robot, remedy="two agents use this id: switch one off, or give it another"
            )
        if (waiting := self._changed.pop(robot, None)) is not None:
            waiting.set()

    def is_doubled(self, robot: str) -> bool:
        """Whether two agents use this robot's id now: then nothing is planned for them."""
        return self._doubled.is_doubled(robot, self._clock.now())

    def doubled_detail(self) -> str:
        """Count the robots whose id two agents use; return a text for /readyz that names them, empty without any."""
        found = self._doubled.found(self._clock.now())
        DOUBLED.set(len(found))
        return f"two agents use the id of {', '.join(found)}" if found else ""

    async def next_state(self, robot: str, after: float) -> RobotState:
        """Return the robot's first state whose `clock` is not `after`; raises `CommandError` when none comes."""
        found = self._states.get(robot)
        if found is not None and found[0].clock != after and self._age(found[1]) <= STATE_MAX_AGE_S:
            return found[0]
        waiting = self._changed.setdefault(robot, asyncio.Event())
        try:
            async with asyncio.timeout(STATE_MAX_AGE_S):
                await waiting.wait()
        except TimeoutError:
            raise CommandError(_silent(robot)) from None
        return self._states[robot][0]

    async def send(self, kind: CommandKind, robot: str, who: str, pose: Pose | None = None) -> CommandReply:
        """Send a command (`initial_pose` with a pose) in the name of `who`; return the robot's reply.

        It is recorded in the audit trail first, a stop afterwards. Raises `CommandError`, and `StoreError` for a
        command that could not be recorded and was not sent.
        """
        self._overrule(robot)
        if kind in STOPS:
            try:
                return await self._deliver(kind, robot, who)
            finally:
                await self._record_stop(robot, {"kind": kind}, who, kind)
        state = self.fresh_state(robot)
        detail = {"kind": kind, **({} if pose is None else {"pose": pose})}
        await self._store.record_command(robot, msgspec.json.encode(detail), Audit(self._clock.stamp(), who, kind))
        return await self._deliver(kind, robot, who, state, pose)

    async def hand_over(self, robot: str, given: HandOver) -> CommandReply:
        """Tell a robot that it leaves this floor, which is recorded; return its reply. Raises `CommandError`."""
        return await self._deliver("hand_over", robot, given.who, self.fresh_state(robot), given=given)

    async def stop(self, robot: str, sender: str, *, each: bool = False) -> CommandReply:
        """Stop a robot for anybody, with a token or without; return its reply. Raises `CommandError`.

        Repetitions are recorded together. Of who may command robots `each` stop is recorded that is none: another's,
        or one of a robot that was enabled meanwhile.
        """
        self._overrule(robot)
        self.stopped_at = self._clock.now()
        known = self._stopped_by.setdefault(robot, set())
        always = each and sender not in known
        known.update({sender} if each else ())
        try:
            return await self._deliver("disable", robot, sender)
        finally:
            alone = self._stops.count(robot, sender, self._clock.now(), always=always)
            if alone and not await self._record_stop(robot, {"kind": "disable"}, sender, "stop", anybody=True):
                self._stops.unrecorded(robot, sender, self._clock.now())

    def _overrule(self, robot: str) -> None:
        try:
            self.overruled(robot)
        except Exception as error:  # noqa: BLE001  # a stop comes first
            # Whatever is wrong with a visit keeps no stop from the robot.
            _log.error("not_overruled", robot=robot, reason=repr(error))

    async def stop_all(self, missions: MissionPersistence, who: str) -> None:
        """Stop all robots that were ever heard, and end all missions; what does not succeed is logged.

        No stop waits for the store.
        """
        self.stopped_at = self._clock.now()

        async def stop(robot: str) -> None:
            try:
                await self.send("disable", robot, who)
            except CommandError as error:
                _log.warning("robot_not_stopped", robot=robot, who=who, reason=str(error))

        async def end_missions() -> None:
            for robot in list(missions.goals):
                try:
                    await missions.cancel(robot, who)
                except StoreError as error:
                    _log.warning("mission_not_ended", robot=robot, who=who, reason=str(error))

        await asyncio.gather(*(stop(robot) for robot in list(self._states)), end_missions())

    async def record_loop(self) -> None:
        """Record, from time to time, how often stops without a token were repeated."""
        async for _ in ticker(self._clock, _RECORDS_PERIOD_S):
            await self.record_repeated_stops()

    async def record_repeated_stops(self) -> None:
        """Record how often stops without a token were repeated, for the robots for which that is due."""
        for robot, repeats in self._stops.due(self._clock.now()).items():
            detail = {"kind": "disable", "repeats": repeats, "period_s": PERIOD_S}
            most = max(repeats, key=repeats.__getitem__)
            if await self._record_stop(robot, detail, most, "stop", anybody=True):
                self._stops.recorded(robot, repeats, self._clock.now())

    async def _deliver(
        self,
        kind: CommandKind,
        robot: str,
        who: str,
        state: RobotState | None = None,
        pose: Pose | None = None,
        given: HandOver | None = None,
    ) -> CommandReply:
        """Send a command, which needs a state unless it is a stop; raises `CommandError`."""
        commands = RobotCommands(self._zenoh, operator=who, key=self._key)
        try:
            patience = REPLY_TIMEOUT_S * max(1.0, self._clock.speed)
            reply = await commands.send(kind, robot, state, pose, patience, given=given)
        except ContractError as error:
            raise CommandError(f"robot {robot} gave an invalid reply: {error}. Check that versions match") from error
        if reply is None:
            raise CommandError(
                f"robot {robot} did not answer within {REPLY_TIMEOUT_S:.0f} s: check that its agent runs and is"
                " connected, and whether it has carried the command out"
            )
        told = {"robot": robot, "kind": kind, "who": who, "accepted": reply.accepted, "reason": reply.reason}
        if kind == "disable":  # anybody may stop a robot at any rate
            self._limited.info("robot_commanded", f"{robot} {who} {reply.accepted}", self._clock.now(), **told)
        else:
            _log.info("robot_commanded", **told)
        return reply

    def fresh_state(self, robot: str) -> RobotState:
        """Return the latest state of a robot that can be commanded; raises `CommandError`."""
        if self._key is None:
            raise CommandError(
                "this planner has no operators' key, so it can only stop robots: set FOGNAV_OPERATOR_KEY_FILE to the"
                " site's operator.key, and restart it"
            )
        state = self.heard(robot)
        if state is None:
            raise CommandError(_silent(robot))
        return state

    def heard(self, robot: str) -> RobotState | None:
        """Return a robot's latest state, None if it is old or there is none."""
        found = self._states.get(robot)
        return found[0] if found is not None and self._age(found[1]) <= STATE_MAX_AGE_S else None

    def _age(self, received_at: float) -> float:
        return self._clock.now() - received_at

    async def _record_stop(self, robot: str, detail: object, who: str, action: str, *, anybody: bool = False) -> bool:
        """Record a stop once it was sent: it must reach the robot whatever the store does. Return whether it could."""
        record = self._store.record_stop if anybody else self._store.record_command
        try:
            await record(robot, msgspec.json.encode(detail), Audit(self._clock.stamp(), who, action))
        except StoreError as error:
            _log.error("stop_not_recorded", robot=robot, who=who, reason=str(error))
            return False
        return True


def _silent(robot: str) -> str:
    return (
        f"robot {robot} has published no state for {STATE_MAX_AGE_S:.0f} s: check that its agent runs and is connected"
    )
