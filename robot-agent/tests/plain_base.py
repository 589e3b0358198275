"""A guardian's core on a base whose commands are readable."""

from __future__ import annotations

import msgspec

from robot_agent.guardian.core import GuardianCore, Limits
from robot_agent.guardian.link import WheelCommand
from robot_agent.hardware import Awakening, BaseReading, BaseStatus, BaseTiming, DriveTrain, WheelOdometry

ONE_RATE = Awakening(bauds=(115_200,))


class PlainBase:
    """A base whose commands are readable: its driver returns what it was asked for."""

    corrupted = 0

    def __init__(
        self, top_speed: float = 0.5, awakening: Awakening = ONE_RATE, ignored_after_wake: float = 0.1
    ) -> None:
        self.timing = BaseTiming(frame_timeout=0.3, wake_timeout=1.0, ignored_after_wake=ignored_after_wake)
        self.awakening = awakening
        self.drive_train = DriveTrain(axle_m=0.235, wheel_speed_max_m_s=top_speed)
        self.frames: list[BaseReading] = []
        self.bauds: list[int] = []

    def receive_data(self, data: bytes, now: float) -> None:
        del data, now

    def next_event(self) -> BaseReading | None:
        return self.frames.pop(0) if self.frames else None

    def wake(self) -> bytes:
        return b"wake;"

    def respond(self) -> bytes:
        return b""

    def use_baud(self, baud: int) -> None:
        self.bauds.append(baud)

    def drive(self, left_m_s: float, right_m_s: float) -> bytes:
        return f"{left_m_s:.4f},{right_m_s:.4f};".encode()


class DockingBase(PlainBase):
    """One that finds its dock by itself; `ready` to leave it again."""

    ready = True

    def seek_dock(self) -> bytes:
        return b"seek;"

    def leave_dock(self) -> bytes:
        return b"full;" if self.ready else b""

    def take_control(self, *, charging: bool) -> bytes:
        return b"start;" if charging else b"take;"


class Rig:
    """A guardian on a plain base that is woken at `begin`, and awake since 0.1 s later."""

    _reported = BaseStatus()

    def __init__(
        self,
        limits: Limits | None = None,
        top_speed: float = 0.5,
        *,
        awake: bool = True,
        begin: float = 0.0,
        base: PlainBase | None = None,
    ) -> None:
        self.base = base or PlainBase(top_speed)
        self.core = GuardianCore(self.base, limits or Limits())
        assert self.core.tick(begin).data == b"wake;"
        if awake:
            self.frame(begin + 0.1)

    def frame(self, now: float, travel: float = 0.0, **status: object):
        odometry = WheelOdometry(left_m=travel, right_m=travel)
        # As of a real driver: the same object for as long as the base reports the same.
        if (reported := msgspec.convert(status, BaseStatus)) != self._reported:
            self._reported = reported
        self.base.frames.append(BaseReading(self._reported, odometry))
        return self.core.on_bytes(b"", now)

    def command(self, now: float, left: float = 0.1, right: float = 0.1, *, reset: bool = False, maneuver=None):
        command = WheelCommand(seq=1, left=left, right=right, reset=reset, maneuver=maneuver)
        return self.core.on_command(command, now)

    def wheels(self, output) -> tuple[float, float] | None:
        words = [word for word in output.data.decode().split(";") if "," in word]
        return tuple(float(part) for part in words[-1].split(",")) if words else None

    def drive(self, begin: float, end: float, left: float = 0.1, right: float = 0.1) -> tuple[float, float]:
        """Command every 0.02 s, with a frame each time; return the last wheel speeds."""
        latest, steps = (0.0, 0.0), round((end - begin) / 0.02)
        for step in range(steps + 1):
            now = begin + step * (end - begin) / steps
            self.frame(now)
            latest = self.wheels(self.command(now, left, right)) or latest
        return latest
