"""A sensor node: the measurement cycle and classification of the firmware, with the timing of the real sonar. Pure.

The sonars measure one after the other, each for its time of flight (36 ms without an echo) but at least until its
echoes have decayed; the reading is published with the last one's, and the firmware pauses. This gives about 8 readings
a second. Source of the timing: HC-SR04 data sheet.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts.messages import AreaState, NodeConfig, NodeReading, SonarStatus
from fog_kernels.sonar import classify, classify_sonars, default_config
from fognav_sim.sensors import SOUND_M_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import NodeCalibration
    from fog_contracts.site import NodeSite
    from fognav_sim.world import World

HEARTBEAT_S: Final = 1.0
EQUAL_READINGS: Final = 10
MOVED_M: Final = 0.1


class PublishPolicy:
    """After a change every reading until ten equal ones have gone out, then one a second; or, as the thesis, every one.

    A change is another state of a sonar, or a range of a blocked one that is 0.1 m off that of the last change.
    """

    def __init__(self, *, every_reading: bool) -> None:
        self._every_reading = every_reading
        self._sonars: list[tuple[AreaState, float]] = []
        self._equal = 0
        self._published = 0.0

    def restart(self) -> None:
        """Publish again as after a change."""
        self._equal = 0

    def update(self, states: Sequence[AreaState], ranges: Sequence[float | None], now: float) -> bool:
        """Take each sonar's state and range (m; None for no echo) at `now` (s); return whether they go out."""
        shown = [(state, measured or 0.0) for state, measured in zip(states, ranges, strict=True)]
        if not self._sonars:
            self._sonars = [("unknown", 0.0)] * len(shown)
        for index, ((state, measured), (before, reference)) in enumerate(zip(shown, self._sonars, strict=True)):
            if state != before or (state == "blocked" and abs(measured - reference) > MOVED_M):
                self._sonars[index] = shown[index]
                self._equal = 0
        repeated = self._equal < EQUAL_READINGS
        self._equal += repeated
        if not (self._every_reading or repeated or now - self._published >= HEARTBEAT_S):
            return False
        self._published = now
        return True


NO_ECHO_S: Final = 0.036
"""The module ends its pulse after about 38 ms without an echo; the firmware times out just before."""
ECHO_DECAY_S: Final = 0.055
"""From a trigger to the next: the mean of the firmware's, which vary."""
FIRMWARE: Final = "sim-1"


class SonarNode:
    """One sensor node of the site."""

    def __init__(self, node: NodeSite, boot: int, start: float) -> None:
        self.node = node
        self._publish = PublishPolicy(every_reading=node.every_reading)
        self.config = default_config(node)
        self._boot = boot
        self._seq = 0
        self._started = start
        self._due = start
        self._index = 0
        self._ranges: list[float | None] = []
        self._triggered = start

    def configure(self, config: NodeConfig) -> bool:
        """Apply a configuration; return False if it is for another number of sonars, and ignore it."""
        count = len(self.node.sonars)
        if len(config.range_limit_m) != count or len(config.no_echo_is_clear) != count:
            return False
        self.config = config
        self._publish.restart()
        return True

    def on_connected(self) -> None:
        """Publish as after a change: the connection has come back."""
        self._publish.restart()

    def command(self, _text: str) -> str | None:
        """Return why no command is obeyed."""
        return "the model of a node obeys no commands: install a C++ compiler, and it runs the firmware"

    def take_calibration(self) -> NodeCalibration | None:
        """Return None: a model learns nothing."""
        return None

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Measure up to `now` (s); return the readings that it publishes, oldest first."""
        readings: list[NodeReading] = []
        if now - self._due > 1.0:
            # The simulation paused: a node does not catch up on readings that it missed.
            self._due = now
        while self._due <= now:
            if self._index < len(self.node.sonars):
                measured = world.sonar(self.node, self._index)
                flight = NO_ECHO_S if measured is None else 2 * measured / SOUND_M_S
                self._ranges.append(measured)
                self._index += 1
                self._triggered = self._due
                self._due += ECHO_DECAY_S if self._index < len(self.node.sonars) else flight
                continue
            if self._publish.update(classify_sonars(self._ranges, self.config), self._ranges, self._due):
                readings.append(self._reading())
            self._index, self._ranges = 0, []
            self._due = self._triggered + ECHO_DECAY_S + self.config.pause_ms / 1000
        return readings

    def _reading(self) -> NodeReading:
        self._seq += 1
        status: list[SonarStatus] = ["no_echo" if measured is None else "ok" for measured in self._ranges]
        return NodeReading(
            seq=self._seq,
            boot=self._boot,
            uptime_ms=round((self._due - self._started) * 1000),
            range_m=[None if measured is None else round(measured, 4) for measured in self._ranges],
            status=status,
            state=classify(self._ranges, self.config),
            rssi=-55,
            fw=FIRMWARE,
        )
