"""Commands through the planner: what it accepted stays accepted, whatever else goes wrong."""

from dataclasses import dataclass, field
from typing import Any

import pytest

from fognav.operate import robot_commands
from fognav.operate.fog import Fog, RefusedError
from fognav.operate.systems import System


@dataclass(frozen=True)
class ExpiredToken(Fog):
    """A planner that accepts commands, and refuses the caller's token where something is read."""

    system: System = field(default_factory=lambda: System(name="fog", kind="fog node", site="lab", urls={}, pids={}))

    def send(self, method: str, *_: object, **__: object) -> Any:
        if method == "GET":
            raise RefusedError("the planner refused it: unknown token", 401)
        return {"accepted": True, "reason": "disabled", "mode": "INIT"}


def test_stop_is_not_called_failed_for_a_token_that_may_not_read_the_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FOGNAV_TOKEN", "expired")
    outcome = robot_commands.stop_by_planner(ExpiredToken(), "r1")
    assert (outcome.accepted, outcome.reason, outcome.mode) == (True, "disabled", "INIT")
