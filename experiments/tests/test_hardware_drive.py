"""Drives of a robot with a person at a terminal, who is scripted; robot and fog node are the real cores in lockstep."""

import asyncio
import math
import os
import pty
import signal
import tty
from functools import partial
from pathlib import Path

import msgspec
import pytest
import ring_site as ring

from fog_contracts import channels as ch
from fog_contracts.messages import Pose, RobotGoal
from fog_runtime.configuration.site import load_site
from fognav.operate.fog import Outcome
from fognav.output import FailedError, WrongUseError
from fognav_experiments.comparison.drives import RouteDraw, RouteSpec, start_of
from fognav_experiments.comparison.hardware_drive import HardwareRun, Terminal, drive_hardware
from fognav_experiments.comparison.records import Folder
from fognav_experiments.comparison.runner import Task
from fognav_experiments.rigs import System
from fognav_sim.barrier import barrier_across

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
SITE = ring.ring_site()
DRAWN = RouteDraw(
    run=1, route=RouteSpec(start="west", goal="east", areas=["z1"]), seed=3, theta=ring.START.theta, area="z1",
    moment="under way", trigger_m=0.5,
)  # fmt: skip


class Person:
    """Reads the terminal, and answers each question by a script; `does` is called with each of its questions."""

    def __init__(self, answers, does=str):
        self.terminal, self.tty = pty.openpty()
        tty.setcbreak(self.tty)
        os.set_blocking(self.terminal, False)
        self.read, self._answered = "", 0
        self._answers = answers
        self._does = does

    def say(self, text):
        os.write(self.tty, f"{text}\n".encode())

    def act(self):
        try:
            self.read += os.read(self.terminal, 65536).decode()
        except BlockingIOError:
            return
        lines = self.read.splitlines()
        for line in lines[self._answered :]:
            for question, answer in self._answers.items():
                if question in line:
                    self._does(question)
                    os.write(self.terminal, f"{answer}\n".encode())
        self._answered = len(lines)


class LockstepRobot:
    """A robot, its fog node and its floor in lockstep, as the command sees them; the person acts whenever it waits."""

    id = "r1"

    def __init__(self):
        self.system = System(SITE, SITE.site.robots[0], 3)
        self.state = self.pose = self.person = None
        self._paths, self._goals = [], 0
        self.commands, self.missions_ended = [], 0
        self.system.bus.subscribe({
            ch.ROBOT_STATE: lambda _ids, state, _at: setattr(self, "state", state) or (),
            ch.ROBOT_POSE: lambda _ids, pose, _at: setattr(self, "pose", pose) or (),
            ch.ROBOT_PATH: lambda _ids, path, _at: self._paths.append(path) or (),
        })  # fmt: skip

    def now(self):
        return self.system.now

    def take_paths(self):
        taken, self._paths = self._paths, []
        return taken

    async def wait(self):
        for _ in range(10):
            self.system.step()
        self.person.act()
        await asyncio.sleep(0)

    async def command(self, kind, pose=None):
        self.commands.append(kind)
        reply = self.system.robot.command(kind, pose)
        return Outcome(accepted=reply.accepted, reason=reply.reason, mode=None)

    async def set_goal(self, place):
        self._goals += 1
        target = SITE.site.places[place]
        goal = RobotGoal(goal_id=f"goal-{self._goals}", pose=Pose(x=target.x, y=target.y, theta=0.0))
        self.system.fog.planner.set_goal(self.id, goal, any_heading=True)
        return goal.goal_id

    async def end_goal(self):
        self.missions_ended += 1
        self.system.fog.planner.core.cancel(self.id)


def guide(robot, person, files, *tasks):
    """Let the command run to its end."""
    robot.person = person

    async def run():
        with Terminal(person.tty, person.say) as terminal:
            await HardwareRun(SITE, robot, terminal).run(tasks, files)

    asyncio.run(run())


@pytest.mark.drive
def test_a_person_is_told_where_to_put_robot_and_barrier_and_the_drive_is_recorded(tmp_path):
    robot, files = LockstepRobot(), Folder(tmp_path).measured("hardware")
    barrier = barrier_across(SITE.site.areas[0], SITE.site, SITE.map, DRAWN.seed)

    def does(question):
        if question == "Now block":
            robot.system.world.place(barrier)

    person = Person({"Put robot r1 at west": "", "Now block": "", "Did the robot touch": "n"}, does)
    guide(robot, person, files, Task(DRAWN, "fog"))
    (record,) = files.read()
    assert (record.name, record.kind, record.outcome) == ("0001-westeast-fog", "hardware", "reached"), record.reason
    assert record.success
    assert 0.5 <= record.barrier_at_m < 2.0
    assert record.route_areas == []  # warned in time, it went round
    assert record.distance_m == pytest.approx(robot.system.world.distance, abs=0.5)
    assert f"({barrier.polygon[0][0]:.1f}, {barrier.polygon[0][1]:.1f})" in person.read
    assert robot.commands[0] == "disable"
    assert robot.commands[-1] == "disable"
    # A drive that stands is not asked for again.
    guide(robot, person, files, Task(DRAWN, "fog"))
    assert person.read.count("Put robot") == 1


def test_a_drive_that_is_skipped_or_ended_leaves_no_record_and_a_robot_at_rest(tmp_path):
    robot, files = LockstepRobot(), Folder(tmp_path).measured("hardware")
    guide(robot, Person({"Put robot": "s"}), files, Task(DRAWN, "fog"))
    assert not files.read()
    with pytest.raises(FailedError, match="repeat the command to go on"):
        guide(robot, Person({"Put robot": "", "Now block": "q"}), files, Task(DRAWN, "fog"))
    assert not files.read()
    assert robot.commands[-1] == "disable"
    asyncio.run(robot.wait())
    assert not robot.state.enabled


class UnreadyRobot(LockstepRobot):
    """It lets itself be enabled, and holds until somebody mended it."""

    def __init__(self):
        super().__init__()
        self.mended = False

    async def wait(self):
        await super().wait()
        if not self.mended and self.state is not None:
            self.state = msgspec.structs.replace(self.state, mode="HOLD", reasons=["its wheels are blocked"])


def test_a_robot_that_is_enabled_but_not_ready_is_disabled_before_a_person_is_asked_to_mend_it(tmp_path):
    robot, files, commands = UnreadyRobot(), Folder(tmp_path).measured("hardware"), []

    def does(question):
        if question == "Mend that":
            commands.extend(robot.commands)
            assert not robot.state.enabled
            robot.mended = True

    person = Person({"Put robot": "", "Mend that": "", "Now block": "e", "Did the robot touch": "n"}, does)
    guide(robot, person, files, Task(DRAWN, "fog"))
    assert commands[-3:] == ["profile_fog", "enable", "disable"]
    assert "is not ready in setup fog: " in person.read
    assert "its wheels are blocked" in person.read
    assert person.read.count("Mend that") == 1
    (record,) = files.read()  # it was enabled again for the drive
    assert record.reason == "a person ended the drive"


class DeafRobot(LockstepRobot):
    """It stops answering operators, or the planner does, as soon as it is on its way."""

    def __init__(self, *, robot_answers, planner_answers):
        super().__init__()
        self._answers = robot_answers, planner_answers

    async def command(self, kind, pose=None):
        if self._goals and not self._answers[0]:
            self.commands.append(kind)
            raise FailedError("robot r1 does not answer")
        return await super().command(kind, pose)

    async def end_goal(self):
        if self._goals and not self._answers[1]:
            raise FailedError("the planner does not answer")
        await super().end_goal()


@pytest.mark.parametrize(
    ("robot_answers", "planner_answers", "told"),
    [(False, True, "robot r1 does not answer"), (True, False, "the planner does not answer")],
)
def test_a_drive_is_ended_at_the_planner_and_at_the_robot_even_if_one_of_them_does_not_answer(
    tmp_path, robot_answers, planner_answers, told
):
    robot = DeafRobot(robot_answers=robot_answers, planner_answers=planner_answers)
    person = Person({"Put robot": "", "Now block": "e"})
    with pytest.raises(FailedError, match=told):
        guide(robot, person, Folder(tmp_path).measured("hardware"), Task(DRAWN, "fog"))
    assert robot.commands[-1] == "disable"
    assert robot.missions_ended == (2 if planner_answers else 1)  # once before it was put at the start


def test_ctrl_c_stops_the_robot_and_ends_its_mission(tmp_path):
    robot, files = LockstepRobot(), Folder(tmp_path).measured("hardware")

    def does(question):
        if question == "Now block":
            assert robot.state.enabled
            signal.raise_signal(signal.SIGINT)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # a test runner's worker may ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            guide(robot, Person({"Put robot": "", "Now block": ""}, does), files, Task(DRAWN, "fog"))
    finally:
        signal.signal(signal.SIGINT, handler)
    assert robot.commands[-1] == "disable"
    assert robot.missions_ended == 2  # once before it was put at the start
    assert not files.read()
    asyncio.run(robot.wait())
    assert not robot.state.enabled


def test_a_barrier_stands_from_the_first_enter_on(tmp_path):
    robot, files, asked_at = LockstepRobot(), Folder(tmp_path).measured("hardware"), []
    presses = "\n" * 20 + "e"  # a line is read every 0.1 s
    person = Person(
        {"Put robot": "", "Now block": presses, "Did the robot touch": "n"},
        lambda question: asked_at.append(robot.system.world.distance) if question == "Now block" else None,
    )
    guide(robot, person, files, Task(DRAWN, "fog"))
    (record,) = files.read()
    assert record.barrier_at_m == pytest.approx(asked_at[0], abs=0.15)
    assert robot.system.world.distance > asked_at[0] + 0.4


def test_what_a_person_saw_decides_whether_the_robot_touched_something(tmp_path):
    robot, files = LockstepRobot(), Folder(tmp_path).measured("hardware")
    person = Person({"Put robot": "", "Now block": "e", "Did the robot touch": "y"})
    guide(robot, person, files, Task(DRAWN, "fog"))
    (record,) = files.read()
    assert (record.outcome, record.success, record.barrier_at_m) == ("contact", False, None)


@pytest.mark.parametrize("typed", ["s", "q"])
def test_a_drive_that_is_over_is_neither_skipped_nor_ended_but_recorded(tmp_path, typed):
    robot, files = LockstepRobot(), Folder(tmp_path).measured("hardware")
    answers = {"Put robot": "", "Now block": "e", "Did the robot touch": typed}

    def does(question):
        if question == "Did the robot touch":
            answers[question] = "y"  # to the question when it is asked again

    guide(robot, Person(answers, does), files, Task(DRAWN, "fog"))
    (record,) = files.read()
    assert (record.outcome, record.success) == ("contact", False)


def test_nobody_is_asked_for_ever_at_a_terminal_that_was_closed():
    terminal = Script("q")
    terminal.closed = True
    with pytest.raises(FailedError, match="the terminal was closed"):
        asyncio.run(HardwareRun(SITE, None, terminal)._ask_whether("Did the robot touch anything?"))


class Script:
    """A terminal at which these lines are typed, one after each question."""

    closed = False

    def __init__(self, *lines):
        self.said, self._lines = [], list(lines)
        self.typed = partial(self._lines.pop, 0)

    def say(self, text):
        self.said.append(text)

    def forget(self):
        pass


@pytest.mark.parametrize(
    ("typed", "touched"),
    [(["y"], True), (["yes"], True), (["n"], False), (["no"], False), ([""], False), (["ja", "yes"], True)],
)
def test_yes_and_no_are_understood_and_anything_else_is_asked_again(typed, touched):
    terminal = Script(*typed)
    run = HardwareRun(SITE, None, terminal)
    assert asyncio.run(run._ask_whether("Did the robot touch anything?")) is touched
    assert sum("touch" in line for line in terminal.said) == len(typed)


def test_a_robot_that_a_person_turned_is_told_its_heading(tmp_path):
    robot, files = LockstepRobot(), Folder(tmp_path).measured("hardware")
    start = start_of(SITE, DRAWN)
    turned = msgspec.structs.replace(start, theta=start.theta + math.pi)
    robot.system.world.kidnap(turned)
    robot.person = Person({})

    async def end_last_drive():
        for _ in range(60):  # until it has scans
            await robot.wait()
        await robot.command("initial_pose", turned)
        for _ in range(60):  # until these have verified the pose
            await robot.wait()

    asyncio.run(end_last_drive())
    assert robot.pose.localized
    assert math.cos(robot.pose.theta - start.theta) < -0.9
    robot.commands.clear()

    def does(question):
        if question == "Put robot":
            robot.system.world.kidnap(start)

    person = Person({"Put robot": "", "Now block": "e", "Did the robot touch": "n", "Mend that": "q"}, does)
    guide(robot, person, files, Task(DRAWN, "fog"))
    (record,) = files.read()
    assert robot.commands[:3] == ["disable", "initial_pose", "profile_fog"]
    assert record.reason == "a person ended the drive"
    assert not record.stops


def test_a_person_is_told_once_that_the_driving_robot_stopped_for_good(tmp_path):
    robot, files = LockstepRobot(), Folder(tmp_path).measured("hardware")

    def does(question):
        if question == "Now block":
            x, y, theta = robot.system.world.pose
            robot.system.world.kidnap(Pose(x=x, y=y, theta=theta + math.pi))

    person = Person({"Put robot": "", "Now block": "", "Robot r1 is in": "e", "Did the robot touch": "n"}, does)
    guide(robot, person, files, Task(DRAWN, "fog"))
    (record,) = files.read()
    assert record.reason == "a person ended the drive"
    assert person.read.count("Robot r1 is in PROTECTIVE_STOP: ") == 1
    assert "initial pose. e ends the drive." in person.read  # the reason is told, with its remedy


def test_without_a_terminal_nobody_can_be_asked(tmp_path, monkeypatch):
    with Path(os.devnull).open() as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        with pytest.raises(WrongUseError, match="run it in a terminal"):
            drive_hardware(load_site(ESTIG), [], Folder(tmp_path).measured("hardware"), None, None, "", print)
