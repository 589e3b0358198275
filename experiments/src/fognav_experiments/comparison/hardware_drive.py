"""The experiment with a real robot: a person places robot and barriers, and the drives are recorded like all others."""

from __future__ import annotations

import asyncio
import math
import os
import sys
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts.commands import PROFILE_OF, STOPS
from fog_runtime import logs
from fognav import __version__
from fognav.operate import robot_commands
from fognav.operate.fog import RefusedError
from fognav.operate.robot_commands import connect
from fognav.output import FailedError, WrongUseError
from fognav.programs import PLANNER
from fognav_experiments.comparison.drives import PROFILE_OF_SETUP, GuidedDrive, stands_at, start_of, where_to_place
from fognav_experiments.comparison.robot_metrics import RobotUsage, watch
from fognav_sim.drive.drive import DriveOutcome
from fognav_sim.drive.hazard import HazardRequest, HazardSchedule

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import TracebackType
    from typing import Self

    from fog_contracts.messages import CommandKind, Mode, Pose, ProfileName, RobotPath, RobotPose, RobotState
    from fog_runtime.configuration.site import LoadedSite
    from fognav.operate.fog import Fog, Outcome
    from fognav.operate.robot_commands import Robot
    from fognav_experiments.comparison.drives import MeasuredDrive
    from fognav_experiments.comparison.records import DriveFiles
    from fognav_experiments.comparison.runner import Task
    from fognav_sim.drive.hazard import PlannedHazard

PERIOD_S: Final = 0.1
READY_S: Final = 30.0
"""How long a robot may take until it is ready to drive, or knows where it was put."""
_STOPPED: Final[tuple[Mode, ...]] = ("PROTECTIVE_STOP", "FAULT")
_SKIP: Final = "s"
_QUIT: Final = "q"
_END: Final = "e"
_YES: Final = ("y", "yes")
_NO: Final = ("n", "no", "")
_ENDED: Final = "ended: repeat the command to go on with this drive"


class ConnectedRobot:
    """A robot that is sent on routes: commands as `fognav robot` sends them, goals by the planner of its fog node."""

    def __init__(self, fog: Fog, connected: Robot) -> None:
        self._fog = fog
        self._connected = connected

    @property
    def id(self) -> str:
        """Its id."""
        return self._connected.id

    @property
    def state(self) -> RobotState | None:
        """The latest state that it published."""
        return self._connected.state

    @property
    def pose(self) -> RobotPose | None:
        """The latest pose that it published."""
        return self._connected.pose

    def now(self) -> float:
        """Return the monotonic time, s."""
        return self._connected.clock.now()

    def take_paths(self) -> list[RobotPath]:
        """Return what the planner published for it since the last call."""
        return self._connected.take_paths()

    async def wait(self) -> None:
        """Wait for `PERIOD_S`."""
        await self._connected.clock.sleep(PERIOD_S)

    async def command(self, kind: CommandKind, pose: Pose | None = None) -> Outcome:
        """Send an operator's command; raises `FailedError` if the robot does not answer."""
        if kind in STOPS:
            return await self._connected.stop(kind)
        return await asyncio.to_thread(robot_commands.command, self._fog, self.id, kind, pose)

    async def set_goal(self, place: str) -> str:
        """Send it to a place; return the goal's id."""
        answer = await asyncio.to_thread(self._fog.send, "PUT", PLANNER, self._goal, {"place": place})
        return str(answer["goal_id"])

    async def end_goal(self) -> None:
        """End its mission, if it has one."""
        try:
            await asyncio.to_thread(self._fog.send, "DELETE", PLANNER, self._goal)
        except RefusedError as error:
            if error.code != "no_mission":
                raise

    @property
    def _goal(self) -> str:
        return f"/api/v1/robots/{self.id}/goal"


class Terminal:
    """Lines that a person types."""

    def __init__(self, descriptor: int, say: Callable[[str], None]) -> None:
        """Read from this file descriptor; `say` shows a line."""
        self._descriptor = descriptor
        self.say = say
        self._text = b""
        self._closed = False

    def __enter__(self) -> Self:
        asyncio.get_running_loop().add_reader(self._descriptor, self._read)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        asyncio.get_running_loop().remove_reader(self._descriptor)

    def typed(self) -> str | None:
        """Return the next line that was typed, None if there is none; a terminal that was closed says `q`."""
        line, end, rest = self._text.partition(b"\n")
        if not end:
            return _QUIT if self._closed else None
        self._text = rest
        return line.decode(errors="replace").strip().lower()

    @property
    def closed(self) -> bool:
        """Whether nobody can type any more."""
        return self._closed

    def forget(self) -> None:
        """Forget what was typed before a question."""
        self._text = b""

    def _read(self) -> None:
        try:
            data = os.read(self._descriptor, 4096)
        except OSError:  # on Linux: the other end of a terminal is gone
            data = b""
        if not data:
            self._closed = True
            asyncio.get_running_loop().remove_reader(self._descriptor)
        self._text += data


class _SkippedError(Exception):
    """The person skips this drive."""


class HardwareRun:
    """Leads a person and a robot through drives of an experiment."""

    def __init__(self, site: LoadedSite, robot: ConnectedRobot, terminal: Terminal, commit: str = "") -> None:
        """`commit`: the program's revision, which is only recorded."""
        self._site = site
        self._robot = robot
        self._terminal = terminal
        self._commit = commit

    async def run(self, asked: Sequence[Task], files: DriveFiles[MeasuredDrive]) -> None:
        """Drive those that have not succeeded yet; raises `FailedError` when the person ends it.

        What failed stays beside what is driven again.
        """
        made = {task.name: files.attempts(task.name) for task in asked}
        due = [task for task in asked if not any(drive.success for drive in made[task.name])]
        self._terminal.say(
            f"{len(due)} drives to go. At each question before a drive: Enter goes on, {_SKIP} skips the drive, "
            f"{_QUIT} ends the command; while the robot drives, {_END} ends the drive. Ctrl-C stops the robot always."
        )
        for number, task in enumerate(due, start=1):
            self._terminal.say(f"Drive {number} of {len(due)}: {task.name}")
            try:
                record = await self.drive(task)
            except _SkippedError:
                continue
            record = msgspec.structs.replace(record, attempt=len(made[task.name]) + 1)
            files.write(record)
            self._terminal.say(f"{record.name}: {record.outcome}, {record.distance_m:.1f} m ({record.reason})")

    async def drive(self, task: Task) -> MeasuredDrive:
        """Drive one route; the robot stands disabled afterwards, however it ended."""
        drawn = task.drawn
        request = HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m)
        planned = HazardSchedule.of(self._site, drawn.seed, request).planned
        assert planned is not None
        usage = RobotUsage()
        try:
            await self._bring_to_start(start_of(self._site, drawn), drawn.route.start)
            if drawn.moment == "before":
                await self._ask(f"Block {where_to_place(planned)}.")
            await self._make_ready(PROFILE_OF_SETUP[task.setup])
            goal_id = await self._robot.set_goal(drawn.route.goal)
            pose = self._robot.pose
            assert pose is not None
            guided = GuidedDrive(self._site, drawn, task.setup, goal_id=goal_id, pose=pose, now=self._robot.now())
            if drawn.moment == "before":
                guided.on_barrier_placed(planned)
            watching = asyncio.create_task(watch(usage, self._metrics, self._robot.now, self._terminal.say))
            try:
                outcome = await self._follow(guided)
            finally:
                watching.cancel()
        finally:
            await self._halt()
        touched = await self._ask_whether("Did the robot touch anything?")
        load = round(os.getloadavg()[0], 2)
        record = guided.record(outcome, touched=touched, load=load, version=__version__, commit=self._commit)
        return msgspec.structs.replace(record, **usage.fields())

    def _metrics(self) -> str:
        return "" if self._robot.state is None else self._robot.state.metrics

    async def _bring_to_start(self, start: Pose, name: str) -> None:
        degrees = round(math.degrees(start.theta))
        await self._halt()
        while True:
            await self._ask(
                f"Put robot {self._robot.id} at {name} ({start.x:.2f}, {start.y:.2f}), heading {degrees} degrees, and "
                "take every barrier away."
            )
            if stands_at(self._robot.pose, start):
                return
            told = await self._robot.command("initial_pose", start)
            if told.accepted and await self._until(lambda: stands_at(self._robot.pose, start)):
                return
            pose = self._robot.pose
            known = "nothing of its place"
            if pose is not None:
                heading = round(math.degrees(pose.theta))
                known = f"that it is at ({pose.x:.2f}, {pose.y:.2f}), heading {heading} degrees"
            self._terminal.say(f"Robot {self._robot.id} says {known} ({told.reason}).")

    async def _make_ready(self, setup: ProfileName) -> None:
        kind = next(kind for kind, profile in PROFILE_OF.items() if profile == setup)
        while True:
            outcome = await self._robot.command(kind)
            if outcome.accepted:
                outcome = await self._robot.command("enable")
            if outcome.accepted and await self._until(self._is_ready):
                return
            state = self._robot.state
            reasons = "; ".join(state.reasons) if state is not None else "it publishes no state"
            self._terminal.say(f"Robot {self._robot.id} is not ready in setup {setup}: {outcome.reason}; {reasons}.")
            await self._halt()  # enabled, it would move beside the person as soon as it is ready
            await self._ask("Mend that, to try again.")

    def _is_ready(self) -> bool:
        state = self._robot.state
        return state is not None and state.mode == "NORMAL"

    async def _follow(self, guided: GuidedDrive) -> DriveOutcome:
        """Return how the drive ends; have the barrier placed meanwhile."""
        robot, asked, known, stopped_in = self._robot, None, self._robot.state, None
        self._terminal.forget()
        while True:
            await robot.wait()
            now = robot.now()
            for path in robot.take_paths():
                guided.on_path(path, now)
            if robot.pose is not None:
                guided.on_pose(robot.pose)
            # The state from before the goal may tell of another arrival.
            if robot.state is not None and robot.state is not known:
                known = robot.state
                guided.on_state(robot.state, now)
                stopped_in = self._tell_stop(robot.state, stopped_in)
            if (outcome := guided.outcome(now)) is not None:
                return outcome
            if asked is None and (asked := guided.barrier_due()) is not None:
                self._terminal.say(f"\aNow block {where_to_place(asked)}. Press Enter when it stands.")
            if (ended := self._typed_while_driving(guided, asked)) is not None:
                return ended

    def _tell_stop(self, state: RobotState, told: Mode | None) -> Mode | None:
        """Tell the person of a stop that the robot may not leave by itself; return its mode, None if it has not."""
        if state.mode not in _STOPPED:
            return None
        if state.mode != told:
            reasons = "; ".join(state.reasons)
            self._terminal.say(f"\aRobot {self._robot.id} is in {state.mode}: {reasons}. {_END} ends the drive.")
        return state.mode

    def _typed_while_driving(self, guided: GuidedDrive, asked: PlannedHazard | None) -> DriveOutcome | None:
        typed = self._terminal.typed()
        if typed == _QUIT:
            raise FailedError(_ENDED)
        if typed == _END:
            return DriveOutcome("stopped", "a person ended the drive")
        if typed == "" and asked is not None:
            guided.on_barrier_placed(asked)
        return None

    async def _ask(self, request: str) -> str:
        """Ask, and return the answer; raises `_SkippedError`, and `FailedError` if the person ends it."""
        answer = await self._answer(request)
        if answer == _QUIT:
            raise FailedError(_ENDED)
        if answer == _SKIP:
            raise _SkippedError
        return answer

    async def _ask_whether(self, question: str) -> bool:
        """Ask until the answer is yes or no, also of who wants to skip or end: the drive that it is about is over.

        Raises `FailedError` if the terminal is closed.
        """
        while (answer := await self._answer(f"{question} y: yes, n or nothing: no.")) not in (*_YES, *_NO):
            if self._terminal.closed:
                raise FailedError(f"the terminal was closed, and nobody answered {question!r} Repeat this drive")
            self._terminal.say(f"{answer!r} is neither yes nor no, and the drive is recorded only with one of them.")
        return answer in _YES

    async def _answer(self, request: str) -> str:
        self._terminal.forget()
        self._terminal.say(f"{request} Then press Enter.")
        while (answer := self._terminal.typed()) is None:
            await self._robot.wait()
        return answer

    async def _until(self, condition: Callable[[], bool]) -> bool:
        """Wait until a condition holds; return False if it does not within `READY_S`."""
        ends = self._robot.now() + READY_S
        while not condition():
            if self._robot.now() > ends:
                return False
            await self._robot.wait()
        return True

    async def _halt(self) -> None:
        """Stop the robot, and end its mission; a failure of one leaves out nothing of the other."""
        try:
            await self._robot.command("disable")
        finally:
            await self._robot.end_goal()
        self._robot.take_paths()


def drive_hardware(  # noqa: PLR0913  # what is driven, where, and by whom
    site: LoadedSite,
    asked: Sequence[Task],
    files: DriveFiles[MeasuredDrive],
    fog: Fog,
    robot: str | None,
    commit: str,
    say: Callable[[str], None],
) -> None:
    """Drive those that have no record yet with a real robot of a fog node, and a person at this terminal.

    Raises `WrongUseError` without a terminal or for another site's fog node, `FailedError` for a robot that does not
    answer, and when the person ends it.
    """
    if not sys.stdin.isatty():
        raise WrongUseError("--hardware asks a person to place robot and barriers: run it in a terminal")
    if fog.site != site.site.id:
        raise WrongUseError(f"the fog node {fog.system.name} is of site {fog.site}: name its folder with --site")
    logs.configure("experiment", "error", "text")
    setups = list(dict.fromkeys(task.setup for task in asked))
    # All routes of a setup one after another: each begins where the one before has ended.
    ordered = sorted(asked, key=lambda task: (task.drawn.run, setups.index(task.setup)))

    async def drive_all() -> None:
        async with connect(fog, fog.robot(robot)) as connected:
            with Terminal(sys.stdin.fileno(), say) as terminal:
                await HardwareRun(site, ConnectedRobot(fog, connected), terminal, commit).run(ordered, files)

    asyncio.run(drive_all())
