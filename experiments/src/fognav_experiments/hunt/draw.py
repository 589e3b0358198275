"""Draws random worlds: floors, what maps and sensors get wrong about them, and what happens.

What sensors, floors and radios do is drawn from recordings of real ones: lidars that lose whole patches and sectors,
odometry with a bias, maps good to 5 to 10 cm, radios with a long tail. Everything else is drawn to be unkind.
"""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec
import numpy as np

from fog_runtime.configuration import parts
from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fognav_experiments.hunt.world import Box, HuntWorld, Mounting, Patch, Sensors, Watched
from fognav_experiments.scenarios.description import (
    BadLine,
    BlindLidar,
    BusyRadio,
    ClockChange,
    Command,
    DeadAgent,
    DeceivedNode,
    FaultyNode,
    FrozenLidar,
    HeldWheel,
    Hole,
    HungAgent,
    LinkGap,
    NoGoZone,
    Obstacle,
    Person,
    Push,
    Restart,
    SilentLidar,
    SilentNode,
    SlewedNode,
    SlowLink,
    SpeedZone,
)
from fognav_sim.emulators import BASES, LIDARS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.grid import StaticMap
    from fognav_experiments.rigs import FogProcessName
    from fognav_experiments.scenarios.description import AnyEvent
    from fognav_experiments.scenarios.stage import Fault

    CommandName = Literal["enable", "disable", "cancel", "egress", "back_off", "turn", "advance", "reset"]

_PROCESSES: Final[tuple[FogProcessName, ...]] = ("aggregator", "map-service", "planner")
_FAULTS: Final[tuple[Fault, ...]] = ("stuck", "flapping", "lies-clear", "lies-blocked")
_COMMANDS: Final[tuple[CommandName, ...]] = (
    "enable", "disable", "egress", "egress", "back_off", "turn", "advance", "reset",
)  # fmt: skip
_SLEWS: Final = (0.083333, 0.0005, 0.001)
"""What chrony slews by at most, the kernel for NTP, and twice that."""
_QUIRKS: Final[tuple[dict[str, int | float | bool], ...]] = (
    {"mode_offset": 1}, {"mode_noise": 7}, {"text_period_s": 5.0}, {"damaged": 9}, {"mode_change_s": 0.1},
    {"stays_safe_on_dock": True}, {"mode_offset": 1, "mode_noise": 11, "text_period_s": 0.7, "damaged": 9},
)  # fmt: skip
"""Of single Roombas, as their owners report them."""
_DECEPTIONS: Final[tuple[dict[str, float], ...]] = (
    {"lost": 1.0}, {"lost": 0.5}, {"scale": 0.0, "offset": 0.3}, {"offset": 1.2}, {"offset": -0.4}, {"scale": 1.125},
    {"scale": 0.9}, {"stray": 0.2}, {"stray": 1.0}, {"scale": 0.0, "offset": 3.9},
)  # fmt: skip
"""Dead, covered, something on it, detours, temperatures, cross-talk, always the same from afar."""
_LIDAR_M: Final = 0.25
_WALL_M: Final = 0.5
_DOOR_M: Final = 0.9
_HEADING_BIAS: Final = math.radians(2.5) * 0.235
"""Difference of the wheels' scales that turns a Roomba by 2.5 degrees a metre: the recorded deviation."""
_KEEP_M: Final = 2.5
"""Nothing is put down nearer to the robot than this: nobody could stop."""
_SPEED_M_S: Final = 0.10


class _Floor(NamedTuple):
    """A drawn floor: its name, its boxes, and where robots and people are."""

    kind: str
    size: tuple[float, float]
    free: list[Box]
    pillars: list[Box]
    opened: list[Box]
    places: list[Box]
    """Where starts, goals, zones and things are drawn."""
    watched: list[Watched]


def draw_world(seed: int, number: int, attempt: int = 0) -> HuntWorld:
    """Return the world of this number in the sequence of a seed.

    Its start or goal may not be free: make the next attempt then.
    """
    dice = random.Random(f"{seed} {number} {attempt}")  # noqa: S311  # repeatable, not a secret
    kinds: list[Callable[[random.Random], _Floor]] = [_corridor, _hall, _office, _office]
    floor = dice.choice(kinds)(dice)
    sensors = _sensors(dice, floor)
    start, goal = _start_and_goal(dice, floor)
    distance = math.dist(start[:2], goal)
    resolution = dice.choice((0.05, 0.05, 0.05, 0.10))
    warp = dice.choice((0.0, dice.uniform(0.02, 0.08)))
    placed = [_thing(dice, dice.choice(floor.places)) for _ in range(dice.choice((0, 0, 0, 1, 3)))]
    base = dice.choice((DEFAULT_BASE, dice.choice(parts.names(BASES))))
    world = HuntWorld(
        title=f"{floor.kind}, seed {seed}, number {number}",
        start=start,
        goal=goal,
        size=floor.size,
        free=floor.free,
        pillars=floor.pillars,
        opened=floor.opened,
        placed=[box for box in placed if _apart(box, start) > 0.5 and _apart(box, goal) > 0.5],
        resolution=resolution,
        warp_m=round(warp, 3),
        radius=dice.choice((0.17, 0.17, 0.17, 0.22)),
        base=base,
        lidar=dice.choice((DEFAULT_LIDAR, dice.choice(parts.names(LIDARS)))),
        mounting=_mounting(dice),
        quirks=dice.choice(_QUIRKS) if base == DEFAULT_BASE and dice.random() < 0.3 else {},
        watched=floor.watched,
        sensors=sensors,
        events=_events(dice, floor, distance),
        demo=bool(floor.watched) and dice.random() < 0.3,
        seconds=round(40.0 + 2.0 * distance / _SPEED_M_S * 0.5),
        seed=dice.randrange(1, 1_000_000),
    )
    return msgspec.convert(msgspec.to_builtins(world), HuntWorld)


def draw_on_map(seed: int, number: int, attempt: int, file: str, recorded: StaticMap) -> HuntWorld:
    """Return a world on the floor of a map's file; attempts as by `draw_world`."""
    dice = random.Random(f"{seed} {number} {attempt} {file}")  # noqa: S311  # repeatable, not a secret
    rows, columns = np.nonzero(recorded.cells == 0)
    cell = dice.randrange(len(rows))
    x, y = recorded.geometry.centre(int(columns[cell]), int(rows[cell]))
    turn, reach = dice.uniform(-math.pi, math.pi), dice.uniform(5.0, 20.0)
    goal = (round(x + reach * math.cos(turn), 2), round(y + reach * math.sin(turn), 2))
    around: Box = (x - 15.0, y - 15.0, x + 15.0, y + 15.0)
    floor = _Floor(file, (1.0, 1.0), [], [], [], [around], [])
    return HuntWorld(
        title=f"{file}, seed {seed}, number {number}",
        start=(round(x, 2), round(y, 2), round(dice.uniform(-math.pi, math.pi), 2)),
        goal=goal,
        map=file,
        warp_m=dice.choice((0.0, 0.05)),
        mounting=_mounting(dice),
        sensors=_sensors(dice, floor),
        events=_events(dice, floor, reach),
        seconds=200.0,
        seed=dice.randrange(1, 1_000_000),
    )


# --- floors ----------------------------------------------------------------------------------------------------------


def _corridor(dice: random.Random) -> _Floor:
    length, width = dice.uniform(15.0, 60.0), dice.uniform(1.2, 3.0)
    bottom, top = 2.0, 2.0 + width
    hall: Box = _rounded(_WALL_M, bottom, _WALL_M + length, top)
    rooms, opened = [], []
    for _ in range(dice.choice((0, 0, 1, 2, 5))):
        x = dice.uniform(2.0, length - 2.0)
        above = dice.random() < 0.5
        door = _rounded(x, top if above else bottom - 1.2, x + _DOOR_M, top + 1.2 if above else bottom)
        rooms.append(door)
        if dice.random() < 0.5:
            opened.append(door)
    watched = _watched(dice, (5.0, length - 5.0), bottom, top, rooms)
    size = (length + 2 * _WALL_M, top + 2.0)
    return _Floor("corridor", _size(size), [hall, *rooms], [], opened, [hall], watched)


def _hall(dice: random.Random) -> _Floor:
    width, depth = dice.uniform(8.0, 22.0), dice.uniform(8.0, 22.0)
    hall = _rounded(_WALL_M, _WALL_M, _WALL_M + width, _WALL_M + depth)
    pillars = [_thing(dice, hall) for _ in range(dice.choice((0, 2, 6)))]
    return _Floor("hall", _size((width + 1.0, depth + 1.0)), [hall], pillars, [], [hall], [])


def _office(dice: random.Random) -> _Floor:
    length, width, deep = dice.uniform(14.0, 28.0), dice.uniform(1.5, 2.4), dice.uniform(3.0, 4.5)
    bottom = _WALL_M + deep + 0.2
    top = bottom + width
    free, opened = [_rounded(_WALL_M, bottom, _WALL_M + length, top)], []
    rooms = []
    for low, high, door_low, door_high in (
        (_WALL_M, bottom - 0.2, bottom - 0.2, bottom),
        (top + 0.2, top + 0.2 + deep, top, top + 0.2),
    ):
        x = _WALL_M
        while x + 3.0 < _WALL_M + length:
            wide = min(dice.uniform(3.0, 5.0), _WALL_M + length - x)
            rooms.append(_rounded(x, low, x + wide - 0.2, high))
            begin = dice.uniform(x + 0.3, x + wide - 0.2 - _DOOR_M - 0.2)
            door = _rounded(begin, door_low, begin + _DOOR_M, door_high)
            free.append(door)
            if dice.random() < 0.2:
                opened.append(door)
            x += wide
    watched = _watched(dice, (4.0, length - 4.0), bottom, top, free[1:])
    size = (length + 2 * _WALL_M, top + deep + 0.2 + _WALL_M)
    return _Floor("office", _size(size), [*free, *rooms], [], opened, [free[0], *rooms], watched)


def _watched(
    dice: random.Random, range_x: tuple[float, float], bottom: float, top: float, doors: list[Box]
) -> list[Watched]:
    """Return an area of a corridor with a node on its lower wall, mostly: it faces a wall, and no door."""
    free = [
        x
        for x in (dice.uniform(*range_x) for _ in range(8))
        if not any(left - 0.6 < x < right + 0.6 for left, _, right, _ in doors)
    ]
    if not free or dice.random() < 0.2:
        return []
    x = free[0]
    half = dice.uniform(0.8, 1.5)
    box = _rounded(x - half, bottom, x + half, top)
    node = (round(x, 2), round(bottom + 0.05, 2), round(math.pi / 2, 4))
    return [Watched(id="a1", box=box, node=node, limit=round(min(3.5, top - bottom - 0.35), 2))]


def _thing(dice: random.Random, place: Box) -> Box:
    """Return something of up to 0.8 m somewhere in a box."""
    left, bottom, right, top = place
    wide, deep = dice.uniform(0.1, 0.8), dice.uniform(0.1, 0.8)
    x, y = dice.uniform(left, max(left, right - wide)), dice.uniform(bottom, max(bottom, top - deep))
    return _rounded(x, y, x + wide, y + deep)


def _start_and_goal(dice: random.Random, floor: _Floor) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Return places far from each other, well inside their boxes."""
    found = max(((_inside(dice, floor), _inside(dice, floor)) for _ in range(3)), key=lambda pair: math.dist(*pair))
    (x, y), goal = found
    return (x, y, round(dice.uniform(-math.pi, math.pi), 2)), goal


def _inside(dice: random.Random, floor: _Floor) -> tuple[float, float]:
    left, bottom, right, top = dice.choice(floor.places)
    margin = min(0.6, 0.4 * (right - left), 0.4 * (top - bottom))
    return round(dice.uniform(left + margin, right - margin), 2), round(dice.uniform(bottom + margin, top - margin), 2)


# --- sensors ---------------------------------------------------------------------------------------------------------


def _sensors(dice: random.Random, floor: _Floor) -> Sensors:
    encoder = dice.choice((0.0, dice.gauss(0.0, 0.025), dice.choice((-0.1, -0.05, 0.05, 0.1))))
    bias = dice.choice((0.0, dice.gauss(0.0, _HEADING_BIAS)))
    gains = dice.choice(((1.0, 1.0), (dice.uniform(0.95, 1.18), dice.uniform(0.95, 1.18))))
    recorded = dice.random() < 0.7
    patches = []
    for _ in range(dice.choice((0, 0, 2, 6)) if recorded else 0):
        left, bottom, right, top = dice.choice(floor.places)
        patches.append(Patch(
            x=round(dice.uniform(left, right), 2), y=round(dice.choice((bottom, top)), 2),
            radius=round(dice.uniform(0.3, 2.0), 2), returned=round(dice.betavariate(0.5, 0.5), 2),
        ))  # fmt: skip
    dead = []
    for _ in range(dice.choice((0, 0, 0, 1, 2)) if recorded else 0):
        begin, wide = dice.uniform(0.6, 5.0), math.radians(dice.uniform(20.0, 80.0))
        dead.append((round(begin, 2), round(min(begin + wide, 5.7), 2)))
    return Sensors(
        recorded=recorded,
        patches=patches,
        dead=dead,
        scale=(round(1.0 + encoder - bias / 2, 4), round(1.0 + encoder + bias / 2, 4)),
        gain=(round(gains[0], 3), round(gains[1], 3)),
        wander=dice.choice((0.0, 0.05)),
        slip=dice.choice((0.01, 0.01, 0.03)),
        grip=dice.choice((0.0, 0.0, 2.5, 1.0)),
        sonar_miss=dice.choice((0.0, 0.0, 0.05)),
        sonar_spike=dice.choice((0.004, 0.01)),
    )


def _mounting(dice: random.Random) -> Mounting:
    """Return a mounting, mostly the usual one: over the axle, its zero ahead."""
    if dice.random() < 0.6:
        return Mounting()
    masks = []
    for _ in range(dice.choice((0, 0, 1, 3))):
        begin = dice.uniform(0.8, 5.0)
        masks.append((round(begin, 2), round(begin + dice.uniform(0.1, 0.4), 2)))
    return Mounting(
        x=round(dice.choice((0.0, dice.uniform(-0.12, 0.12))), 3),
        y=round(dice.choice((0.0, dice.uniform(-0.08, 0.08))), 3),
        yaw=round(dice.choice((0.0, math.pi / 2, math.pi, dice.uniform(-math.pi, math.pi))), 4),
        mirrored=dice.random() < 0.4,
        masks=masks,
    )


# --- events ----------------------------------------------------------------------------------------------------------


def _events(dice: random.Random, floor: _Floor, distance: float) -> list[AnyEvent]:
    """Draw what happens: nothing, one thing, or several, some of them at the same time."""
    events: list[AnyEvent] = []
    honest = True
    at = [dice.uniform(0.0, 0.7 * distance / 0.25) for _ in range(6)]
    at[1] = dice.choice((at[0], at[1]))  # two at once
    at[3] = at[2] + dice.uniform(0.0, 5.0)  # one soon after the other
    for at_s in at[: dice.choice((0, 1, 2, 4, 6))]:
        event, lies = _event(dice, floor, round(at_s, 1))
        honest = honest and not lies
        events.append(event)
    # What nodes that are not honest must see, nobody can tell.
    return [
        msgspec.structs.replace(event, area=None) if isinstance(event, Obstacle) and not honest else event
        for event in events
    ]


def _event(  # noqa: C901, PLR0911, PLR0912  # a table of the kinds of events
    dice: random.Random, floor: _Floor, at_s: float
) -> tuple[AnyEvent, bool]:
    """Return an event, and whether a node lies by it; what is soft hides what stands beside or behind it."""
    place = dice.choice((floor.places[0], dice.choice(floor.places)))
    node = f"n-{floor.watched[0].id}" if floor.watched else ""
    kind = dice.choice((
        "zone", "zone", "command", "speed", "thing", "person", "gap", "slow", "radio", "restart", "hang", "lidar",
        "dead", "frozen", "blind", "stall", "line", "clocks", "hole", "low", "wheel", "push",
        *(("barrier", "barrier", "silent", "lie", "deceived", "deceived", "soft", "clock") if node else ()),
    ))  # fmt: skip
    seconds = round(dice.choice((dice.uniform(0.5, 5.0), dice.uniform(5.0, 60.0))), 1)
    match kind:
        case "zone":
            return NoGoZone(at_s=at_s, polygon=_ring(_zone(dice, place)), seconds=dice.choice((0.0, seconds))), False
        case "speed":
            return SpeedZone(
                at_s=at_s, polygon=_ring(_zone(dice, place)), speed=round(dice.uniform(0.05, 0.2), 2)
            ), False
        case "thing":
            box = _thing(dice, place)
            return Obstacle(at_s=at_s, polygon=_ring(box), seconds=dice.choice((0.0, seconds)), keep_m=_KEEP_M), False
        case "person":
            line = [_inside(dice, floor._replace(places=[place])) for _ in range(dice.randint(2, 4))]
            return Person(at_s=at_s, line=line, speed=round(dice.uniform(0.4, 1.4), 2)), False
        case "gap":
            down, up = dice.choice(((True, True), (True, False), (False, True)))
            return LinkGap(at_s=at_s, seconds=seconds, down=down, up=up), False
        case "slow":
            return SlowLink(at_s=at_s, seconds=seconds, delay_s=round(dice.uniform(0.05, 1.5), 2)), False
        case "radio":
            return BusyRadio(at_s=at_s, seconds=300.0, gaps_per_min=round(dice.uniform(0.0, 6.0), 1)), False
        case "restart":
            process = dice.choice(_PROCESSES)
            return Restart(at_s=at_s, process=process, seconds=seconds), False
        case "hang":
            return HungAgent(at_s=at_s, seconds=seconds), False
        case "lidar":
            return SilentLidar(at_s=at_s, seconds=seconds), False
        case "dead":
            return DeadAgent(at_s=at_s, seconds=seconds), False
        case "frozen":
            return FrozenLidar(at_s=at_s, seconds=seconds, turns=dice.choice((1, 1, 2, 5))), False
        case "blind":
            begin, wide = dice.uniform(-math.pi, math.pi), dice.uniform(0.3, 2.1)
            return BlindLidar(at_s=at_s, begin=round(begin, 2), end=round(begin + wide, 2), seconds=seconds), False
        case "stall":
            brief = round(dice.choice((dice.uniform(0.05, 0.15), dice.uniform(0.2, 2.0))), 2)
            return BadLine(at_s=at_s, device=dice.choice(("base", "lidar")), seconds=brief, stalled=True), False
        case "line":
            lost, flipped = dice.choice(((0.0005, 0.0), (0.0, 0.0005), (0.01, 0.0), (0.0, 0.01), (0.1, 0.1)))
            return BadLine(
                at_s=at_s, device=dice.choice(("base", "lidar")), seconds=seconds, lost=lost, flipped=flipped
            ), False
        case "clocks":
            jump = dice.choice((0.0, dice.choice((-3600.0, -30.0, -2.0, -0.5, 0.5, 2.0, 30.0, 3600.0, 1e6))))
            rate = dice.choice((-1.0, 1.0)) * dice.choice(_SLEWS)
            crystal = dice.choice((0.0, -1e-4, 1e-4))
            return ClockChange(
                at_s=at_s,
                computer=dice.choice(("robot", "fog")),
                jump_s=jump,
                rate=rate,
                crystal=crystal,
                seconds=seconds,
            ), False
        case "hole":
            return Hole(at_s=at_s, polygon=_ring(_thing(dice, place)), keep_m=_KEEP_M), False
        case "low":
            box, height = _thing(dice, place), round(dice.uniform(0.04, _LIDAR_M - 0.01), 2)
            return Obstacle(at_s=at_s, polygon=_ring(box), height=height, keep_m=_KEEP_M), False
        case "wheel":
            return HeldWheel(at_s=at_s, wheel=dice.choice(("left", "right")), seconds=1.0), False
        case "command":
            return Command(at_s=at_s, command=dice.choice(_COMMANDS)), False
        case "push":
            return Push(at_s=at_s, turn=round(math.radians(dice.uniform(-20.0, 20.0)), 3)), False
        case "silent":
            return SilentNode(at_s=at_s, node=node, seconds=seconds), True
        case "clock":
            return SlewedNode(at_s=at_s, node=node, rate=dice.choice((-0.08, -0.001, 0.0005, 0.08))), False
        case "deceived":
            deception = dice.choice(_DECEPTIONS)
            return DeceivedNode(at_s=at_s, node=node, seconds=dice.choice((0.0, seconds)), **deception), True
        case "lie":
            fault = dice.choice(_FAULTS)
            return FaultyNode(at_s=at_s, node=node, fault=fault, seconds=seconds), True
    area = floor.watched[0]
    _, bottom, _, top = area.box
    x = area.node[0]
    barrier = _rounded(x - 0.3, bottom + 0.25, x + 0.3, top - 0.05)
    return Obstacle(
        at_s=at_s, polygon=_ring(barrier), seconds=dice.choice((0.0, seconds)), keep_m=_KEEP_M,
        area=None if kind == "soft" else area.id, soft=kind == "soft",
    ), kind == "soft"  # fmt: skip


def _zone(dice: random.Random, place: Box) -> Box:
    left, bottom, right, top = place
    wide, deep = dice.uniform(0.8, 3.0), dice.uniform(0.8, 3.0)
    x, y = dice.uniform(left, right), dice.uniform(bottom, top)
    return _rounded(max(x, 0.1), max(y, 0.1), x + wide, y + deep)


def _ring(box: Box) -> list[tuple[float, float]]:
    left, bottom, right, top = box
    return [(left, bottom), (right, bottom), (right, top), (left, top)]


def _rounded(left: float, bottom: float, right: float, top: float) -> Box:
    return round(left, 2), round(bottom, 2), round(right, 2), round(top, 2)


def _size(size: tuple[float, float]) -> tuple[float, float]:
    return round(size[0], 2), round(size[1], 2)


def _apart(box: Box, point: Sequence[float]) -> float:
    """Return the distance (m) of a point from a box."""
    left, bottom, right, top = box
    return math.hypot(max(left - point[0], 0.0, point[0] - right), max(bottom - point[1], 0.0, point[1] - top))
