"""The planner's problem documents."""

from fog_runtime.http import ProblemCode


class PlannerProblem(ProblemCode):
    """Problems of the planner."""

    NO_ROBOT = "no_robot", 404, "No robot has this id", "Choose one of GET /api/v1/robots"
    NO_MISSION = "no_mission", 404, "The robot has no mission", "Send it to a goal first"
    NO_PLACE = "no_place", 422, "The site has no such place", "Choose one of GET /api/v1/places"
    NO_POSE = (
        "no_pose", 409, "The planner does not know where the robot is, or has no map yet",
        "Give the robot its pose, or wait for the map",
    )  # fmt: skip
    GOAL_REFUSED = (
        "goal_refused", 422, "The goal can never be reached: `refusal`, and Nav2's `code` and `name`, say why",
        "Choose another goal, such as `nearest`, or remove what is in the way",
    )  # fmt: skip
    DEADLINE_TOO_SOON = (
        "deadline_too_soon", 422, "The mission takes longer than its deadline allows: some `seconds`",
        "Give it more time, or fewer stops",
    )  # fmt: skip
    NO_SCHEDULE = "no_schedule", 404, "No schedule has this id", "Choose one of GET /api/v1/schedules"
    SCHEDULE_CHANGED = (
        "schedule_changed", 412, "The schedule is not the one that the request expects, or there is one",
        "Read it again, then decide anew",
    )  # fmt: skip
    MISSION_CHANGED = (
        "mission_changed", 412, "The robot has another mission than the request expects, or has one",
        "Read the mission again, then decide anew",
    )  # fmt: skip
    ROBOT_DOUBLED = "robot_doubled", 409, "Two agents use this robot's id", "End one of them, or give it another id"
    IN_SERVICE = "in_service", 404, "The robot is in service", "Send it to a goal, or take another one out of service"
    OUT_OF_SERVICE = (
        "out_of_service", 409, "An operator keeps the robot out of service: `detail` says why and till when",
        "Put it back into service, or send another robot",
    )  # fmt: skip
    NO_LIFT = "no_lift", 422, "No lift of this site leads to that floor", "Choose a floor that `detail` names"
    FLOOR_UNKNOWN = (
        "floor_unknown", 409, "The robot does not know that floor",
        "Add the floor to its list of floors, or send another one",
    )  # fmt: skip
    ROBOT_OUTDATED = (
        "robot_outdated", 409, "The robot's software can't take a mission to another floor",
        "Bring its software to this version, or send it to one goal there",
    )  # fmt: skip
    COMMAND_REFUSED = (
        "command_refused", 409, "The robot refuses: `refusal` and `causes` identify why",
        "Do what `causes` ask for, then repeat it",
    )  # fmt: skip
    COMMAND_LOST = (
        "command_lost", 504, "The robot does not answer, or this service has no operators' key",
        "Look whether the robot is on and connected, then repeat it",
    )  # fmt: skip
    VISITS_OFF = "visits_off", 409, "No robot serves visitors", "Name some in [visitors] of site.toml, and restart"
    PLACE_NOT_PUBLIC = (
        "place_not_public",
        422,
        "Visitors can't choose this place",
        "Choose one of GET /api/v1/visits/places",
    )
    VISIT_SAME_PLACE = "visit_same_place", 422, "The visitor is at this place already", "Choose another place"
    VISIT_OTHER = "visit_other", 409, "This browser has another visit, which is not over", "End it, then ask again"
    VISITS_FULL = "visits_full", 503, "Too many visitors wait", "Wait as long as `Retry-After` says"
    VISITS_TOO_OFTEN = "visits_too_often", 429, "Too many visits were asked for", "Wait as long as `Retry-After` says"
    NO_VISIT = "no_visit", 404, "This browser has no visit, or it was over for minutes", "Ask for one"
    VISIT_NOT_READY = "visit_not_ready", 409, "The robot does not wait for the visitor", "Wait until `state` is `ready`"
    BUSY = (
        "busy", 503, "Too many plans wait, or of this client: `Retry-After` says when to try again",
        "Wait as long as `Retry-After` says",
    )  # fmt: skip
