"""The faults: what happens, how it ends, and how soon the wheels must be slow enough or stand."""

from __future__ import annotations

import math
import signal
import time
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from fog_contracts.messages import SimObstacle
from fognav_experiments.bench.reactions.hand import Hand
from fognav_experiments.bench.reactions.rig import AGENT, GUARDIAN, ROUTER, WATCHDOG

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from fognav_experiments.bench.reactions.rig import Rig

Kind = Literal["process", "device", "fog", "operator", "key", "page"]

PROCESS_LIMIT_S: Final = 0.3
"""Longest time that the design allows for stopping the wheels after the end of a process."""
_DEGRADED_M_S: Final = 0.151
_SLOW_M_S: Final = 0.15
"""Faster than this a robot could not rest 0.02 m before a box that is 0.06 m away."""
_CYCLE_S: Final = 0.1
"""Steps of gate, guardian and line, 0.05 and 0.02 s, and the emulated device's 0.01 s, after a limit has passed."""
_POLL_S: Final = 0.05
"""How long a heartbeat or release may wait until the agent of a driving robot looks for it: it counts from then on."""
_READ_S: Final = 0.05
"""How long the lidar's last bytes may wait until the agent reads them: its silence counts from then on."""
_RAMP_S: Final = 0.5
_SLOWING_S: Final = 0.15
"""From 0.30 to 0.15 m/s at the 1 m/s2 that a robot accelerates and brakes with where nothing is dangerous."""
_FRAME_S: Final = 0.05
"""A frame of the base's sensors, 0.015 s, and the guardian's answer on the line."""
_TURN_S: Final = 0.19
"""A turn of the lidar at 5.5 Hz."""
_BOX: Final = "box"


class Fault(NamedTuple):
    """One fault. `limit_s` is None where only hardware could stop the wheels; `design` says what the limit consists of.

    kind: a robot of the kinds "key" and "page" is driven by hand, by a terminal or a page, at 0.15 m/s.
    `begin` makes it happen, `end` undoes it. `speed`: the wheels must be commanded at most this fast (m/s), 0: they
    stand. `observed_s`: how long to look.
    """

    name: str
    kind: Kind
    limit_s: float | None
    design: str
    begin: Callable[[Rig], Awaitable[object] | None]
    end: Callable[[Rig], Awaitable[object] | None]
    speed: float = 0.0
    observed_s: float = 1.2


def _nothing(_rig: Rig) -> None:
    pass


def _signals(rig: Rig, *, names: tuple[str, ...], number: signal.Signals) -> None:
    rig.signal(names, number)


def _process(name: str, names: tuple[str, ...], number: signal.Signals, *, stops: bool = True) -> Fault:
    return Fault(
        name,
        "process",
        PROCESS_LIMIT_S if stops else None,
        "0.3" if stops else "none: needs hardware",
        partial(_signals, names=names, number=number),
        _nothing,
    )


def _switched(  # noqa: PLR0913  # what a fault consists of
    name: str,
    kind: Kind,
    limit_s: float,
    design: str,
    switch: Callable[..., None],
    *,
    speed: float = 0.0,
    observed_s: float = 1.2,
) -> Fault:
    """Return a fault that is switched on and off again; `switch` is called with the rig and `on`."""
    return Fault(name, kind, limit_s, design, partial(switch, on=True), partial(switch, on=False), speed, observed_s)


def _base(rig: Rig, *, sensor: str, on: bool) -> None:
    setattr(rig.body.base.world, sensor, on)


def _sensor(name: str, sensor: str, *, limit_s: float = _FRAME_S, design: str = "one sensor frame: 0.05") -> Fault:
    return _switched(name, "device", limit_s, design, partial(_base, sensor=sensor))


def _full_mode(rig: Rig) -> None:
    """Another host's byte: the base obeys it and goes on driving."""
    with rig.body.lock:
        rig.body.base.receive(bytes((132,)), time.monotonic())


def _noise(rig: Rig, *, on: bool) -> None:
    rig.body.noisy = on


def _lidar(rig: Rig, *, fault: str, on: bool, revolutions: int = 1) -> None:
    rig.body.lidar.frozen_revolutions = revolutions
    setattr(rig.body.lidar, fault, on)


def _blind(rig: Rig, *, on: bool) -> None:
    rig.body.lidar.blind_sector_rad = (-1.0, 1.0) if on else None


def _unplug(rig: Rig) -> None:
    with rig.body.lock:
        rig.body.unplug_lidar()


def _plug(rig: Rig) -> None:
    with rig.body.lock:
        rig.body.plug_lidar()


def _box(rig: Rig, *, ahead_m: float) -> None:
    """Put a box of 0.3 x 0.2 m before the robot, its near side `ahead_m` from the robot's rim."""
    x, y, theta = rig.body.world.pose
    near, far = ahead_m + rig.body.world.robot.radius, ahead_m + rig.body.world.robot.radius + 0.2
    cos, sin = math.cos(theta), math.sin(theta)
    corners = [(near, -0.15), (far, -0.15), (far, 0.15), (near, 0.15)]
    ring = [(x + cos * along - sin * across, y + sin * along + cos * across) for along, across in corners]
    with rig.body.lock:
        rig.body.world.place(SimObstacle(id=_BOX, polygon=ring))


def _no_box(rig: Rig) -> None:
    with rig.body.lock:
        rig.body.world.remove(_BOX)


def _fog(rig: Rig, *, what: str, on: bool) -> None:
    setattr(rig.fog, what, on)


def _zone(rig: Rig, *, ahead_m: float, lost: bool = False) -> None:
    x, y, theta = rig.body.world.pose
    rig.fog.block(x + ahead_m * math.cos(theta), y + ahead_m * math.sin(theta), lost=lost)


def _no_zone(rig: Rig) -> None:
    rig.fog.unblock()


def _ahead(rig: Rig) -> None:
    """Publish a plan on a version of the map that never arrives."""
    rig.fog.seq_ahead = 5
    rig.fog.send_on()


def _not_ahead(rig: Rig) -> None:
    rig.fog.seq_ahead = 0
    rig.fog.send_on()


async def _disable(rig: Rig) -> None:
    rig.fog.operator_silent = True
    await rig.fog.stop_unsigned()


async def _enable(rig: Rig) -> None:
    rig.fog.operator_silent = False


def _by_hand(name: str, kind: Kind, begin: Callable[[Hand], None]) -> Fault:
    def begins(rig: Rig) -> None:
        assert rig.hand is not None
        begin(rig.hand)

    return Fault(name, kind, PROCESS_LIMIT_S, "0.3", begins, _nothing)


KILL, HANG = signal.SIGKILL, signal.SIGSTOP
FAULTS: Final = (
    _process("agent killed", (AGENT,), KILL),
    _process("agent hangs", (AGENT,), HANG),
    _process("guardian killed", (GUARDIAN,), KILL),
    _process("guardian hangs", (GUARDIAN,), HANG),
    _process("watchdog killed", (WATCHDOG,), KILL),
    _process("agent and guardian killed", (AGENT, GUARDIAN), KILL),
    _process("agent and guardian hang", (AGENT, GUARDIAN), HANG),
    _process("agent and watchdog killed", (AGENT, WATCHDOG), KILL),
    _process("agent and watchdog hang", (AGENT, WATCHDOG), HANG),
    _process("watchdog and guardian killed", (WATCHDOG, GUARDIAN), KILL, stops=False),
    _process("watchdog and guardian hang", (WATCHDOG, GUARDIAN), HANG, stops=False),
    _sensor("bumper pressed", "bump_left"),
    _sensor("cliff", "cliff_front_left"),
    _sensor("wheel drops", "wheel_drop_left"),
    _sensor("wheel motor blocked", "overcurrent_left", limit_s=0.3 + _CYCLE_S, design="0.3 of high current + 0.1"),
    Fault("base put into Full mode", "device", _FRAME_S, "one sensor frame: 0.05", _full_mode, _nothing),
    _switched("base: every frame damaged", "device", 0.3 + _CYCLE_S, "0.3 without a frame + 0.1", _noise),
    _switched(
        "lidar falls silent",
        "device",
        _READ_S + 0.3 + _CYCLE_S,
        "read 0.05 + 0.3 + 0.1",
        partial(_lidar, fault="stalled"),
    ),
    Fault("lidar unplugged", "device", 0.3 + _CYCLE_S, "0.3 + 0.1", _unplug, _plug),
    _switched(
        "lidar repeats a turn",
        "device",
        3 * _TURN_S + _CYCLE_S,
        "3 turns of 0.19 + 0.1",
        partial(_lidar, fault="frozen"),
    ),
    _switched(
        "lidar repeats five turns",
        "device",
        3 * _TURN_S + _CYCLE_S,
        "3 turns of 0.19 + 0.1",
        partial(_lidar, fault="frozen", revolutions=5),
    ),
    _switched("lidar sees nothing ahead", "device", 3 * _TURN_S + _CYCLE_S, "3 turns of 0.19 + 0.1", _blind),
    Fault(
        "box 0.06 m ahead, slow",
        "device",
        _TURN_S + _CYCLE_S,
        "a turn of 0.19 + 0.1",
        partial(_box, ahead_m=0.06),
        _no_box,
        _SLOW_M_S,
    ),
    _switched(
        "map silent, slow",
        "fog",
        _POLL_S + 1.0 + _SLOWING_S + _CYCLE_S,
        "poll 0.05 + 1.0 + braking 0.15 + 0.1",
        partial(_fog, what="map_silent"),
        speed=_DEGRADED_M_S,
        observed_s=1.8,
    ),
    _switched(
        "map silent, stop",
        "fog",
        _POLL_S + 3.0 + _RAMP_S + _CYCLE_S,
        "poll 0.05 + 3.0 + ramp 0.5 + 0.1",
        partial(_fog, what="map_silent"),
        observed_s=4.5,
    ),
    _switched(
        "planner silent, slow",
        "fog",
        _POLL_S + 1.5 + _SLOWING_S + _CYCLE_S,
        "poll 0.05 + 1.5 + braking 0.15 + 0.1",
        partial(_fog, what="planner_silent"),
        speed=_DEGRADED_M_S,
        observed_s=2.3,
    ),
    Fault(
        "network gone, slow",
        "fog",
        _POLL_S + 1.0 + _SLOWING_S + _CYCLE_S,
        "poll 0.05 + 1.0 + braking 0.15 + 0.1",
        partial(_signals, names=(ROUTER,), number=HANG),
        _nothing,
        _DEGRADED_M_S,
        1.8,
    ),
    Fault(
        "network gone, stop",
        "fog",
        _POLL_S + 3.0 + _RAMP_S + _CYCLE_S,
        "poll 0.05 + 3.0 + ramp 0.5 + 0.1",
        partial(_signals, names=(ROUTER,), number=HANG),
        _nothing,
        0.0,
        4.5,
    ),
    Fault(
        "change of the map lost",
        "fog",
        _CYCLE_S + _POLL_S + 1.0 + _RAMP_S + _CYCLE_S,
        "next heartbeat 0.1 + poll 0.05 + 1.0 + ramp 0.5 + 0.1",
        partial(_zone, ahead_m=6.0, lost=True),
        _no_zone,
        0.0,
        2.5,
    ),
    Fault(
        "plan on a map that does not arrive",
        "fog",
        1.0 + _RAMP_S + _CYCLE_S,
        "1.0 + ramp 0.5 + 0.1",
        _ahead,
        _not_ahead,
        0.0,
        2.5,
    ),
    Fault("zone over the robot", "fog", _CYCLE_S, "0.1", partial(_zone, ahead_m=0.0), _no_zone),
    Fault("zone on the path", "fog", _RAMP_S + _CYCLE_S, "ramp 0.5 + 0.1", partial(_zone, ahead_m=2.0), _no_zone),
    Fault("unsigned stop", "operator", _CYCLE_S, "0.1", _disable, _enable),
    _by_hand("key released", "key", Hand.let_go),
    _by_hand("teleop killed", "key", partial(Hand.signal, number=KILL)),
    _by_hand("teleop hangs", "key", partial(Hand.signal, number=HANG)),
    _by_hand("page falls silent", "page", Hand.let_go),
    _by_hand("page closed", "page", Hand.close_page),
)
"""A watchdog that hangs alone is none: the wheels keep obeying guardian and agent."""
