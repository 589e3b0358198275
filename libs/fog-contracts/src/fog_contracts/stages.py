"""The stages between a hazard's first reading and the first wheel command, and how long each took. Pure."""

from collections.abc import Mapping, Sequence
from typing import Final

import msgspec

from fog_contracts.messages import Trace

STAGES: Final[Mapping[str, tuple[str, str]]] = {
    "debounce": ("first_reading", "confirmed"),
    "costmap": ("confirmed", "costmap_published"),
    "plan": ("costmap_published", "plan_published"),
    "deliver": ("plan_published", "path_received"),
    "command": ("path_received", "first_command"),
}
"""Each stage lies between two stamps of a `Trace`; they follow one another without a gap."""
TOTAL: Final = "total"
SPANS: Final[Mapping[str, tuple[str, str]]] = {**STAGES, TOTAL: ("first_reading", "first_command")}
"""The stages and their sum, which is the thesis's "around 3 seconds"."""
HAZARD_TO_PATH: Final[Mapping[str, tuple[str, str]]] = {"hazard_to_path": ("first_reading", "path_received")}


def durations_s(trace: Trace | None, spans: Mapping[str, tuple[str, str]] = STAGES) -> dict[str, float]:
    """Return the duration (s) of each span whose two stamps are set.

    A duration is negative when its two stamps come from hosts whose clocks differ.
    """
    if trace is None:
        return {}
    stamps = {name: (getattr(trace, begin), getattr(trace, end)) for name, (begin, end) in spans.items()}
    return {name: end - begin for name, (begin, end) in stamps.items() if begin and end}


def durations_ms(trace: Trace | None, spans: Mapping[str, tuple[str, str]] = STAGES) -> dict[str, float]:
    """Return the duration (ms, rounded to a tenth) of each span whose two stamps are set."""
    return {name: round(1000.0 * seconds, 1) for name, seconds in durations_s(trace, spans).items()}


def hazard_to_path_ms(trace: Trace | None) -> float | None:
    """Return the milliseconds from the hazard's first reading to the robot's new path; None until both are stamped."""
    return durations_ms(trace, HAZARD_TO_PATH).get("hazard_to_path")


class Traces:
    """Merges the traces of many messages into one per state of a hazard (area, epoch, seq)."""

    def __init__(self) -> None:
        self._merged: dict[tuple[str, int, int], Trace] = {}

    def update(self, traces: Sequence[Trace]) -> None:
        """Merge traces; the first stamp of a stage is kept."""
        for trace in traces:
            key = (trace.area, trace.epoch, trace.seq)
            earlier = self._merged.get(key)
            if earlier is None:
                self._merged[key] = trace
                continue
            stamps = {
                name: getattr(earlier, name) or getattr(trace, name)
                for name in trace.__struct_fields__
                if name not in {"area", "epoch", "seq"}
            }
            self._merged[key] = msgspec.structs.replace(earlier, **stamps)

    def earliest(self, area: str, since: float) -> Trace | None:
        """Return the trace of an area with the earliest first reading that is not before `since` (stamp), or None."""
        found = [t for t in self._merged.values() if t.area == area and t.first_reading >= since]
        return min(found, key=lambda t: t.first_reading, default=None)
