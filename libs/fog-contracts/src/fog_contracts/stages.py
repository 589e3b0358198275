"""The stages of a hazard's way from the first reading to the wheels, and how long each took. Pure."""

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
    """Return the seconds that each of the spans took, as far as the trace got.

    A span is negative when its two stamps are of hosts whose clocks differ.
    """
    if trace is None:
        return {}
    stamps = {name: (getattr(trace, begin), getattr(trace, end)) for name, (begin, end) in spans.items()}
    return {name: end - begin for name, (begin, end) in stamps.items() if begin and end}


def durations_ms(trace: Trace | None, spans: Mapping[str, tuple[str, str]] = STAGES) -> dict[str, float]:
    """Return the milliseconds, to a tenth, that each of the spans took, as far as the trace got."""
    return {name: round(1000.0 * seconds, 1) for name, seconds in durations_s(trace, spans).items()}


def hazard_to_path_ms(trace: Trace | None) -> float | None:
    """Milliseconds from the first reading that saw the hazard to the robot's new path, None until then."""
    return durations_ms(trace, HAZARD_TO_PATH).get("hazard_to_path")


class Traces:
    """Collects what messages tell of each hazard's way through the stages."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int, int], Trace] = {}

    def update(self, traces: Sequence[Trace]) -> None:
        """Merge traces: a stage that was reached once stays reached."""
        for trace in traces:
            key = (trace.area, trace.epoch, trace.seq)
            known = self._known.get(key)
            if known is None:
                self._known[key] = trace
                continue
            stamps = {
                name: getattr(known, name) or getattr(trace, name)
                for name in trace.__struct_fields__
                if name not in {"area", "epoch", "seq"}
            }
            self._known[key] = msgspec.structs.replace(known, **stamps)

    def first_of(self, area: str, since: float) -> Trace | None:
        """Return the first trace of an area whose first reading is not older than `since` (stamp)."""
        found = [t for t in self._known.values() if t.area == area and t.first_reading >= since]
        return min(found, key=lambda t: t.first_reading, default=None)
