"""The report of a demonstration (`fognav demo --report`)."""

from collections.abc import Sequence

import msgspec

from fog_contracts.stages import durations_ms, hazard_to_path_ms
from fognav.demo.attempt import Attempt


def modes(attempt: Attempt) -> dict[str, int]:
    """Return how often the robot entered each mode on its drive."""
    return dict(attempt.drive.evaluation.modes) if attempt.drive is not None else {}


def report(attempt: Attempt, given_up: Sequence[dict[str, object]]) -> dict[str, object]:
    """Summarize the last attempt; `given_up` lists the attempts before it that could not sustain their speed."""
    return {
        **_drive(attempt),
        "processes": attempt.usage.report(),
        "restarts": attempt.restarts,
        "modes": modes(attempt),
        "given_up": list(given_up),
        "speed": attempt.scene.speed,
        "asked_speed": attempt.plan.options.speed,
        "sustained_speed": attempt.speed_watch.sustained,
        "events": [f"{at:.1f} {text}" for at, text in attempt.scene.events],
    }


def _drive(attempt: Attempt) -> dict[str, object]:
    options = attempt.plan.options
    trace = attempt.placement.trace() if attempt.placement is not None else None
    return {
        **msgspec.structs.asdict(attempt.summary()),
        "site": attempt.plan.site.site.id,
        "base": options.base,
        "lidar": options.lidar,
        "seed": options.seed,
        "hazard": attempt.plan.hazard,
        "stages_ms": durations_ms(trace),
        "hazard_to_path_ms": hazard_to_path_ms(trace),
    }
