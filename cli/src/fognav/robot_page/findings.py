"""What a robot's parts must be like before it drives: one pure function a finding, from what was seen to a judgement.

What can't be known is `unknown` and says why; it is never taken for `ok`. `computer` beside this judges the computer.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from fog_contracts.messages import Power
    from robot_agent.guardian.link import BaseFeedback

State = Literal["ok", "warn", "bad", "unknown"]

SECTORS: Final = 12
"""Sectors in which missing returns are counted, each 30 degrees wide; the first one's middle is ahead."""
_SILENT_S: Final = 1.0
_RATE_OFF: Final = 0.2
_SAMPLES_LEAST: Final = 180
"""Fewer samples a turn are farther apart than the legs of a chair are wide, 2 m away."""
_MISSING: Final = 0.5
_BLIND: Final = 0.9
_ROLLED_M: Final = 0.3
_UNLIKE: Final = 0.2
_SAG_V: Final = 1.0
"""By how much a sound battery's voltage falls at most when the wheels begin to turn."""
_PRESSED: Final = frozenset({"bumper", "cliff", "wheel_drop"})
"""Faults of the base that pressing its sensors gives."""


_TRY: Final = {"cliff": "hold its front over an edge, or lift it", "wheel_drop": "lift the robot"}


class Finding(NamedTuple):
    """One judgement: its name for programs, its state, what was found, and what to do unless it is `ok`."""

    name: str
    state: State
    text: str
    remedy: str = ""


def settings(file: Path | None, *, in_use: bool) -> Finding:
    """Judge whether there is a settings file, and whether the agent has the lidar as it says."""
    if file is None:
        remedy = "fognav robot new --out robot.toml, then name it by --robot-file"
        return Finding("settings", "warn", "no robot.toml is known: defaults are taken", remedy)
    if not in_use:
        remedy = "restart the agent: systemctl restart fognav-agent"
        return Finding("settings", "warn", f"{file}: the agent runs with another mounting of the lidar", remedy)
    return Finding("settings", "ok", str(file))


def agent(problem: str) -> Finding:
    """Judge whether the robot's agent runs here; `problem`: why it can't be reached, empty if it was."""
    if not problem:
        return Finding("agent", "ok", "the robot's agent runs")
    return Finding("agent", "bad", problem, "journalctl -u fognav-agent tells why; wheels off the floor, start it")


def versions(command: str, agents: str | None) -> Finding:
    """Judge whether this command and the agent (None: it did not tell) are of one version."""
    if agents is None:
        return Finding("versions", "unknown", f"this command is {command}; the agent does not tell its version")
    if agents == command:
        return Finding("versions", "ok", f"command and agent are {command}")
    remedy = "install one version on the robot (deploy/robot/install), and restart the agent"
    return Finding("versions", "bad", f"this command is {command}, the agent {agents}", remedy)


def port(device: str, driver: str, name: str, *, exists: bool, known: Sequence[str]) -> Finding:
    """Judge the serial port of a device ("base" or "lidar"); `known`: the names of those that are plugged in."""
    others = f"plugged in are: {', '.join(known)}" if known else "no serial adapter is plugged in"
    if not name:
        remedy = f"set `port` of [{device}] in robot.toml; {others}"
        return Finding(f"{device}_port", "bad", f"the port of the {driver} is not set", remedy)
    if not exists:
        remedy = f"plug it in, or correct `port` of [{device}] in robot.toml; {others}"
        return Finding(f"{device}_port", "bad", f"{driver}: there is no {name}", remedy)
    return Finding(f"{device}_port", "ok", f"{driver} on {name}")


def lidar(driver: str, problem: str, silent_s: float | None, damaged: int) -> Finding:
    """Judge whether the lidar speaks; `problem`: what its driver says, `damaged`: packets since this began.

    silent_s: since its last whole scan; None before the first one, while it may only be late.
    """
    if problem or (silent_s is not None and silent_s > _SILENT_S):
        text = f"{driver}: {problem or f'no whole scan for {silent_s:.1f} s'}"
        remedy = "its plugs at both ends, and 5 V at its plug while the motor turns; the motor must turn"
        return Finding("lidar", "bad", text, remedy)
    if silent_s is None:
        return Finding("lidar", "unknown", f"{driver}: no whole scan was seen yet")
    if damaged > 0:
        remedy = "if they grow: another cable, away from the motors, and its supply"
        return Finding("lidar", "warn", f"{driver}: it scans, and {damaged} packets were damaged", remedy)
    return Finding("lidar", "ok", f"{driver}: it scans")


def lidar_rate(turns_per_s: float | None, rated_per_s: float | None, samples: float) -> Finding:
    """Judge how fast the lidar turns (None: too few turns were seen), and how many samples a turn has."""
    if turns_per_s is None:
        return Finding("lidar_rate", "unknown", "too few whole turns were seen to tell how fast it turns")
    text = f"{turns_per_s:.1f} turns/s, {samples:.0f} samples a turn"
    if rated_per_s is None:
        return Finding("lidar_rate", "unknown", f"{text}; what this lidar should do is not known without robot.toml")
    text += f" (rated: {rated_per_s:.1f} turns/s)"
    off = abs(turns_per_s / rated_per_s - 1.0)
    if off > 2 * _RATE_OFF or samples < _SAMPLES_LEAST:
        remedy = "its supply (5 V at the plug while it turns), its belt, its cable; nothing may touch the head"
        return Finding("lidar_rate", "bad", text, remedy)
    if off > _RATE_OFF:
        return Finding("lidar_rate", "warn", text, "its supply: 5 V at the plug while it turns; its belt")
    return Finding("lidar_rate", "ok", text)


def lidar_returns(missing: Sequence[float | None], masked: Sequence[bool]) -> Finding:
    """Judge the share of samples without a return by sector (None: no sample), as `SECTORS` counts them.

    masked: whether masks hide all of a sector, in which nothing is expected.
    """
    shares = [share for share in missing if share is not None]
    if not shares:
        return Finding("lidar_returns", "unknown", "no scan was seen yet")
    remedy = (
        "look there: glass, black cloth and what is farther than its range give none; else something covers the head"
    )
    poor = [
        f"{_direction(number)} ({'no sample' if share is None else f'{100 * share:.0f} % missing'})"
        for number, (share, hidden) in enumerate(zip(missing, masked, strict=True))
        if not hidden and (share is None or share > _MISSING)
    ]
    if sum(shares) / len(shares) > _BLIND:
        return Finding("lidar_returns", "bad", "it sees nearly nothing, in no direction", remedy)
    if poor:
        return Finding("lidar_returns", "warn", f"few returns {', '.join(poor)}", remedy)
    worst = max(range(len(missing)), key=lambda number: missing[number] or 0.0)
    most = f"most are missing {_direction(worst)}: {100 * (missing[worst] or 0.0):.0f} %"
    return Finding("lidar_returns", "ok", f"returns from all sides; {most}")


def _direction(sector: int) -> str:
    degrees = round(math.degrees(math.remainder(sector * math.tau / SECTORS, math.tau)))
    names = {0: "ahead", 90: "to the left", 180: "behind", -180: "behind", -90: "to the right"}
    return names.get(degrees) or f"{abs(degrees)} degrees to the {'left' if degrees > 0 else 'right'}"


def own_returns(found: int, *, turned: bool) -> Finding:
    """Judge sectors in which the lidar sees what belongs to the robot itself, and which no mask hides yet.

    turned: whether the robot has turned meanwhile, so that what stayed where it was must be its own.
    """
    if found:
        remedy = "take the proposed masks on the page (fognav robot bringup --page), or move what stands there"
        return Finding(
            "own_returns", "warn", f"the lidar sees the robot itself, in {found} sector{'s'[: found > 1]}", remedy
        )
    if turned:
        return Finding("own_returns", "ok", "the lidar sees no part of the robot")
    text = "no part of the robot inside its outline; what sticks out shows once it has turned a bit (fognav teleop)"
    return Finding("own_returns", "unknown", text)


def base(driver: str, problem: str, feedback: BaseFeedback | None) -> Finding:
    """Judge whether the base speaks and obeys; `problem`: why nothing is heard of it."""
    if feedback is None or problem:
        text = f"{driver}: {problem or 'nothing was heard of it yet'}"
        remedy = "its cable and its battery; a Roomba that sleeps: press CLEAN; systemctl status fognav-watchdog"
        return Finding("base", "bad", text, remedy)
    status = feedback.status
    if feedback.fault is not None:
        tried = feedback.fault_code in _PRESSED
        remedy = "remove its cause, then Reset fault (on the page, or r in `fognav teleop`)"
        return Finding("base", "warn" if tried else "bad", f"{driver}: fault: {feedback.fault}", remedy)
    if status.mode_problem is not None:
        return Finding("base", "bad", f"{driver}: {status.mode_problem}", "pull the charger's cable; press no button")
    if status.charging:
        return Finding("base", "warn", f"{driver}: a charger is connected, it does not drive", "off the dock to drive")
    damaged = f", {feedback.corrupted} damaged frames" if feedback.corrupted else ""
    return Finding("base", "ok", f"{driver}: it speaks and obeys{damaged}")


def switch(name: str, seen: frozenset[bool], *, now: bool) -> Finding:
    """Judge a sensor of the base that is on or off; `seen`: in which of both it was since this began."""
    if len(seen) > 1:
        return Finding(name, "warn", "it works, and is on now", "let go") if now else Finding(name, "ok", "it works")
    if now:
        remedy = "set the robot on the floor, let go; if it stays on: clean the sensor, free the bumper"
        return Finding(name, "warn", "on all the time", remedy)
    return Finding(name, "unknown", "not tried yet", _TRY.get(name, "press it"))


def encoders(left_m: float, right_m: float, counts_per_m: float | None) -> Finding:
    """Judge how far (m) the wheels' counters say that each has rolled since this began."""
    counts = "" if counts_per_m is None else f" ({left_m * counts_per_m:+.0f}, {right_m * counts_per_m:+.0f} counts)"
    text = f"left {left_m:+.3f} m, right {right_m:+.3f} m{counts}"
    roll = "roll the robot straight ahead by hand, half a metre: both must grow alike"
    farther = max(abs(left_m), abs(right_m))
    if farther < _ROLLED_M:
        return Finding("encoders", "unknown", f"{text}: not rolled yet", roll)
    if min(abs(left_m), abs(right_m)) < _UNLIKE * _ROLLED_M:
        side = "left" if abs(left_m) < abs(right_m) else "right"
        return Finding("encoders", "warn", f"{text}: the {side} wheel does not count", f"{roll}; else its encoder")
    if left_m * right_m < 0.0:
        return Finding("encoders", "unknown", f"{text}: it was turned, both count", roll)
    if min(left_m, right_m) < 0.0:
        return Finding("encoders", "warn", f"{text}: backwards", f"{roll}; if they fall: left and right, or A and B")
    return Finding("encoders", "ok", f"{text}: both count")


def battery(charge: float | None, low: float) -> Finding:
    """Judge the battery's charge (of 1), which the robot's settings call low below `low`."""
    if charge is None:
        return Finding("battery", "unknown", "this base does not tell how full its battery is")
    if charge < low:
        return Finding("battery", "warn", f"{100 * charge:.0f} %", "charge it before you drive")
    return Finding("battery", "ok", f"{100 * charge:.0f} %")


def voltage(power: Power | None, rest_v: float | None, load_v: float | None) -> Finding:
    """Judge the battery's voltage (V): the highest at rest, and the lowest while the wheels turned (None: unseen)."""
    if power is None or power.voltage_v is None:
        return Finding("voltage", "unknown", "this base does not tell its battery's voltage")
    current = "" if power.current_a is None else f", {power.current_a:+.2f} A"
    text = f"{power.voltage_v:.2f} V{current}"
    if rest_v is None or load_v is None:
        remedy = "drive a moment by hand, wheels on the floor (the page's pad, or fognav teleop)"
        return Finding("voltage", "unknown", f"{text}; not seen under load yet", remedy)
    text += f"; {rest_v:.2f} V at rest, {load_v:.2f} V while it drives"
    if rest_v - load_v > _SAG_V:
        return Finding("voltage", "warn", text, "clean the battery's contacts; charge it; it may be worn out")
    return Finding("voltage", "ok", text)


def as_json(found: Sequence[Finding]) -> dict[str, object]:
    """Return what `--json` prints; `ok` unless something needed is bad."""
    return {"ok": all(finding.state != "bad" for finding in found), "findings": [f._asdict() for f in found]}


def counts_per_m(options: Mapping[str, object]) -> float | None:
    """Return the counts in a metre that a wheel rolls, by the base's own options; None if they do not tell."""
    counts = options.get("ticks_per_turn", options.get("counts_per_turn"))
    diameter = options.get("wheel_diameter_m")
    if isinstance(counts, float) and isinstance(diameter, float) and diameter > 0.0:
        return counts / (math.pi * diameter)
    return None
