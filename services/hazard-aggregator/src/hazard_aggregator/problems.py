"""The hazard-aggregator's problem documents."""

from fog_runtime.http import ProblemCode, ProblemError


class AreaProblem(ProblemCode):
    """Problems of the hazard-aggregator."""

    NO_AREA = "no_area", 404, "No area has this id", "Choose one of GET /api/v1/areas"
    NO_OVERRIDE = "no_override", 404, "The area has no override", "Do nothing: its sensor nodes decide"
    NO_ALERT = "no_alert", 404, "There is no such alert", "Choose one of GET /api/v1/alerts"
    CLEAR_NEEDS_ADMIN = (
        "clear_needs_admin", 403, "Only an admin may declare an area clear",
        "Ask an admin, or let it become clear by its nodes",
    )  # fmt: skip
    AREA_CHANGED = (
        "area_changed", 412, "The area is not as the request expects: somebody else changed or added it",
        "Read the area again, then decide anew",
    )  # fmt: skip
    AREA_INVALID = (
        "area_invalid",
        422,
        "The area is invalid: `errors` names its fields",
        "Correct the fields that `errors` names",
    )
    TOO_MANY_AREAS = (
        "too_many_areas", 422, "The site has as many areas as it may have",
        "Remove an area, or make a part of the floor a site of its own",
    )  # fmt: skip
    NO_NODE = "no_node", 422, "The site has no such node", "Choose one of GET /api/v1/nodes"
    OVERRIDE_TOO_LONG = (
        "override_too_long", 422, "An area can't be overridden for so long",
        "Choose a shorter time, and override it again later",
    )  # fmt: skip


def no_such_area(area: str) -> ProblemError:
    """Return the problem of a request about an area that does not exist."""
    return ProblemError(AreaProblem.NO_AREA, f"there is no area {area}: GET /api/v1/areas lists those that there are")
