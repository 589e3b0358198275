"""The report of a demonstration (`fognav demo --report`)."""

import math
from collections.abc import Sequence

from fog_contracts.stages import durations_ms, hazard_to_path_ms
from fognav.demo.attempt import Attempt


def modes(attempt: Attempt) -> dict[str, int]:
    """Return how often the robot entered each mode on its drive."""
    return dict(attempt.evaluation.modes) if attempt.evaluation is not None else {}


def report(attempt: Attempt, given_up: Sequence[dict[str, object]]) -> dict[str, object]:
    """Summarize the last attempt; `given_up` lists the attempts before it that could not sustain their speed."""
    return {
        **_outcome(attempt),
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


def _outcome(attempt: Attempt) -> dict[str, object]:
    outcome = attempt.scene.outcome
    return {
        "outcome": outcome.kind if outcome else "stopped",
        "success": attempt.success(),
        "reason": outcome.reason if outcome else "the demo ended before the drive had an outcome",
        "site": attempt.plan.site.site.id,
        "base": attempt.plan.options.base,
        "lidar": attempt.plan.options.lidar,
        "seed": attempt.plan.options.seed,
    }


def _drive(attempt: Attempt) -> dict[str, object]:
    evaluation, trace = attempt.evaluation, attempt.hazard.trace()
    started, ended = (evaluation.started_at if evaluation else 0.0), attempt.ended_at
    return {
        "distance_m": round(evaluation.distance_m, 2) if evaluation else 0.0,
        "time_s": round(ended - started, 2) if evaluation and ended else None,
        "min_clearance_m": _finite(evaluation.min_clearance_m) if evaluation else None,
        "hazard": attempt.plan.hazard,
        "area": attempt.hazard.area,
        "area_entered": evaluation.entered_blocked if evaluation else False,
        "area_clearance_m": _finite(evaluation.blocked_clearance_m) if evaluation else None,
        "route_areas": evaluation.route_areas if evaluation else [],
        "plans": evaluation.plans if evaluation else 0,
        "stages_ms": durations_ms(trace),
        "hazard_to_path_ms": hazard_to_path_ms(trace),
    }


def _finite(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
