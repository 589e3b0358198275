"""Findings about a robot's computer: what /proc, /sys and a few programs tell, and a pure judgement of each.

A program that is not installed, or tells nothing, leaves its finding `unknown`.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from typing import TYPE_CHECKING, Final

import psutil

from fognav.robot_page.findings import Finding
from robot_agent.agent.edges.exporter import ROOT, temperatures, throttling

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

_TIMEOUT_S: Final = 3.0
_WEAK_DBM: Final = -70
_STICKS_DB: Final = 10
_HOT_C: Final = 70.0
_TOO_HOT_C: Final = 80.0
_MB: Final = 1e6
_REAL_TIME: Final = frozenset({os.SCHED_FIFO, os.SCHED_RR})
_WRITERS: Final = ("brltty", "ModemManager")
"""Programs that open new serial ports and write to them."""
_SERVED: Final = "fognav-agent.service sets it: deploy/robot/install installs it"


def wifi_power_save(interface: str | None, told: str | None) -> Finding:
    """Judge what `iw dev NAME get power_save` told (None: it could not be asked)."""
    name = "wifi_power_save"
    if interface is None:
        return Finding(name, "unknown", "this computer has no wireless interface")
    if told is None or "power save" not in told.lower():
        return Finding(name, "unknown", f"{interface}: not known", "install iw (apt-get install iw)")
    if told.strip().lower().endswith("off"):
        return Finding(name, "ok", f"{interface}: off")
    remedy = "deploy/robot/install switches it off (wifi.powersave=2 of NetworkManager); then reboot"
    return Finding(name, "bad", f"{interface}: on, so that an idle link answers after up to 2 s", remedy)


def wifi_roaming(interface: str | None, link: str | None, heard: str | None) -> Finding:
    """Judge the signal by `iw dev NAME link`, and by `iw dev NAME scan dump` other access points of its network."""
    name = "wifi_roaming"
    if interface is None or link is None:
        text = "this computer has no wireless interface" if interface is None else f"{interface}: not known"
        return Finding(name, "unknown", text, "" if interface is None else "install iw (apt-get install iw)")
    signal, network = re.search(r"signal: (-?\d+)", link), re.search(r"SSID: (.+)", link)
    if signal is None or network is None:
        return Finding(name, "warn", f"{interface}: not connected", "join the building's network; the robot needs it")
    level, own = int(signal[1]), network[1].strip()
    levels = [
        float(found[1])
        for point in re.split(r"^BSS ", heard or "", flags=re.MULTILINE)[1:]
        if (found := re.search(r"signal: (-?[\d.]+)", point)) and f"SSID: {own}\n" in point + "\n"
    ]
    others = f"{len(levels)} access points of it are heard" if levels else "which others there are is not known"
    text = f"{interface}: {own} at {level} dBm; {others}"
    if levels and max(levels) - level >= _STICKS_DB:
        remedy = "it stays with the weaker one: equal name, key and band on all of them, and let the supplicant scan"
        return Finding(name, "warn", f"{text}, the strongest at {max(levels):.0f} dBm", f"{remedy} (bgscan)")
    if level < _WEAK_DBM:
        return Finding(name, "warn", text, "an access point nearer to where the robot drives, or another antenna")
    remedy = "" if levels else f"sudo iw dev {interface} scan, once, then look again"
    return Finding(name, "ok" if levels else "unknown", text, remedy)


def clock(tracking: str | None, timedate: str | None) -> Finding:
    """Judge what `chronyc -n tracking` and `timedatectl show` told; the first one counts if both did."""
    remedy = "a time server in its network: docs/robot-setup.md tells how the fog node becomes one"
    if tracking is not None and (leap := re.search(r"Leap status\s*: (.+)", tracking)):
        off = re.search(r"System time\s*: ([\d.]+) seconds", tracking)
        if leap[1].strip() == "Not synchronised":
            return Finding("clock", "warn", "chrony has not synchronised it", remedy)
        return Finding("clock", "ok", f"synchronised by chrony{f', {float(off[1]):.3f} s off' if off else ''}")
    if timedate is not None and "NTPSynchronized=" in timedate:
        if "NTPSynchronized=yes" in timedate:
            return Finding("clock", "ok", "synchronised")
        return Finding("clock", "warn", "not synchronised: dates in logs and recordings are wrong", remedy)
    return Finding("clock", "unknown", "neither chronyc nor timedatectl tells whether it is synchronised", remedy)


def temperature(zones: Mapping[str, float]) -> Finding:
    """Judge the hottest thermal zone (degrees Celsius)."""
    if not zones:
        return Finding("temperature", "unknown", "this computer tells no temperature")
    zone = max(zones, key=lambda name: zones[name])
    text, remedy = f"{zones[zone]:.0f} °C ({zone})", "a heat sink or a fan; it slows itself down from 80 °C"
    if zones[zone] >= _TOO_HOT_C:
        return Finding("temperature", "bad", text, remedy)
    return Finding("temperature", "warn", text, remedy) if zones[zone] >= _HOT_C else Finding("temperature", "ok", text)


def supply(causes: Mapping[str, bool]) -> Finding:
    """Judge what slows a Raspberry Pi down now, by cause."""
    if not causes:
        remedy = "on a Raspberry Pi run `vcgencmd get_throttled` after a drive: nothing else than 0x0 is good"
        return Finding("supply", "unknown", "this computer does not tell whether its supply suffices", remedy)
    held = [cause.replace("_", " ") for cause, holds in causes.items() if holds]
    if causes.get("under_voltage"):
        return Finding("supply", "bad", f"{', '.join(held)}", "its 5 V supply: a stronger converter, a shorter cable")
    return Finding("supply", "warn", ", ".join(held), "let it cool down") if held else Finding("supply", "ok", "steady")


def memory(meminfo: str) -> Finding:
    """Judge what is available by /proc/meminfo."""
    found = re.search(r"^MemAvailable:\s+(\d+) kB", meminfo, re.MULTILINE)
    if found is None:
        return Finding("memory", "unknown", "/proc/meminfo does not tell what is available")
    return _room("memory", int(found[1]) * 1024, 150 * _MB, 300 * _MB, "end other programs on it")


def disk(free_bytes: int, folder: Path) -> Finding:
    """Judge the free space where the robot keeps its data."""
    remedy = "remove old recordings and logs: a full card stops a robot; a recording takes some 2 MB a minute"
    found = _room("disk", free_bytes, 200 * _MB, 1000 * _MB, remedy)
    return found._replace(text=f"{found.text} on {folder}")


def _room(name: str, free: float, least: float, enough: float, remedy: str) -> Finding:
    text = f"{free / _MB:.0f} MB free"
    if free >= enough:
        return Finding(name, "ok", text)
    return Finding(name, "bad" if free < least else "warn", text, remedy)


def real_time(policies: Mapping[str, int | None]) -> Finding:
    """Judge the scheduling policy (`os.SCHED_...`) of each of the robot's processes; None for one that has ended."""
    if not policies:
        return Finding("real_time", "unknown", "which processes the robot has is not known while its agent is silent")
    without = [name for name, policy in policies.items() if policy is not None and policy not in _REAL_TIME]
    if without:
        return Finding("real_time", "warn", f"no real-time priority: {', '.join(without)}", _SERVED)
    return Finding("real_time", "ok", f"{', '.join(policies)} run in real time")


def port_programs(running: Sequence[str]) -> Finding:
    """Judge programs that write to serial ports which are not theirs."""
    if running:
        remedy = f"apt-get remove {' '.join(name.lower() for name in running)}"
        return Finding("port_programs", "bad", f"{', '.join(running)} writes to new serial ports", remedy)
    return Finding("port_programs", "ok", "nothing else writes to serial ports")


def look(
    processes: Mapping[str, int],
    data: Path,
    *,
    root: Path = ROOT,
    ask: Callable[..., str | None] | None = None,
) -> list[Finding]:
    """Look at this computer; it takes a moment. `processes`: the robot's, by name; `data`: the folder of its data."""
    ask = ask or _ask
    interface = next((path.parent.name for path in sorted((root / "sys/class/net").glob("*/wireless"))), None)
    told = {what: ask("iw", "dev", interface, *what.split()) if interface else None for what in _IW}
    existing = next(folder for folder in (data, *data.absolute().parents) if folder.is_dir())
    return [
        port_programs(_running(_WRITERS)),
        wifi_power_save(interface, told["get power_save"]),
        wifi_roaming(interface, told["link"], told["scan dump"]),
        clock(ask("chronyc", "-n", "tracking"), ask("timedatectl", "show")),
        temperature(temperatures(root)),
        supply(throttling(root)),
        memory(_text(root / "proc/meminfo")),
        disk(shutil.disk_usage(existing).free, existing),
        real_time({name: _policy(pid) for name, pid in processes.items()}),
    ]


_IW: Final = ("get power_save", "link", "scan dump")


def _ask(program: str, *arguments: str) -> str | None:
    """Return what a program prints; None if it is not installed, fails or hangs."""
    path = shutil.which(program) or shutil.which(program, path="/usr/sbin:/sbin")
    if path is None:
        return None
    try:
        done = subprocess.run(
            [path, *arguments], check=False, capture_output=True, text=True, timeout=_TIMEOUT_S,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def _running(names: Iterable[str]) -> list[str]:
    running = {process.info["name"] for process in psutil.process_iter(["name"])}
    return [name for name in names if name in running]


def _policy(pid: int) -> int | None:
    try:
        return os.sched_getscheduler(pid)
    except OSError:
        return None


def _text(file: Path) -> str:
    try:
        return file.read_text("utf-8", "replace")
    except OSError:
        return ""
