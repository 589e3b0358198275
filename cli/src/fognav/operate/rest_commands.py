"""Commands to a robot through the planner's REST API, which signs them for who has an operator's token."""

from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from fog_contracts.messages import CommandKind, Pose
from fognav.operate.fog import Fog, RefusedError
from fognav.operate.outcome import Outcome
from fognav.operate.systems import PLANNER
from fognav.output import FailedError


def command(fog: Fog, robot: str, kind: CommandKind, pose: Pose | None = None) -> Outcome:
    """Let the planner sign and send a command; raises `FailedError` when it can't, or has no reply."""
    given = {} if pose is None else {"pose": msgspec.to_builtins(pose)}
    return _outcome(fog, robot, f"/api/v1/robots/{robot}/commands", {"kind": kind, **given})


def stop(fog: Fog, robot: str) -> Outcome:
    """Stop a robot through the planner, which needs no token; raises `FailedError`."""
    return _outcome(fog, robot, f"/api/v1/robots/{robot}/stop", None)


def states(fog: Fog, robot: str) -> Iterator[Mapping[str, Any]]:
    """Yield the planner's view of a robot, now and whenever its state changes; raises `FailedError`."""
    path = f"/api/v1/robots/{robot}"
    view: Mapping[str, Any] = fog.get(PLANNER, path)
    while True:
        state = view["state"]
        if state is not None:
            yield view
        view = fog.get(PLANNER, f"{path}?after={state['clock'] if state is not None else 0.0}")


def _outcome(fog: Fog, robot: str, path: str, body: object) -> Outcome:
    try:
        answer = fog.send("POST", PLANNER, path, body)
    except RefusedError as error:
        if error.status != 409:
            raise
        problem = error.problem
        return Outcome(
            accepted=False,
            reason=error.reason,
            mode=problem.get("mode"),
            code=problem.get("refusal", ""),
            causes=problem.get("causes", []),
        )
    return Outcome(accepted=True, reason=answer["reason"], mode=_mode(fog, robot) or answer["mode"])


def _mode(fog: Fog, robot: str) -> Any:  # noqa: ANN401  # a mode, or None without a token that may read it
    if fog.token is None:
        return None
    try:
        state = fog.get(PLANNER, f"/api/v1/robots/{robot}")["state"]
    except FailedError:  # the robot has obeyed: a token that may not read changes nothing about that
        return None
    return state and state["mode"]
