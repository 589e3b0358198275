"""What was published to robots, recorded for logs, metrics and the API once there is time for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts.messages import RobotPath, RobotRelease
from fog_runtime import logs, metrics

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Publication

MOST_UNRECORDED: Final = 1000
UNRECORDED_S: Final = 0.5
"""After so many publications, or so long, they are recorded although searches are left."""

_log = logs.get("planner")


class PathRecord:
    """Each robot's last path. The core's thread adds publications, the event loop takes them over between cycles."""

    def __init__(self) -> None:
        self.paths: dict[str, RobotPath] = {}
        """Each robot's last path or refusal, as last released."""
        self._sent: list[Publication] = []
        """What was published and is not recorded yet ..."""
        self._unrecorded_since = 0.0
        """... and when the first of it was."""

    def add(self, publications: Sequence[Publication], now: float) -> None:
        """Note what was published; `now` is any monotonic time (s)."""
        if publications and not self._sent:
            self._unrecorded_since = now
        self._sent += publications

    def is_due(self, now: float) -> bool:
        """Whether what was published is to be recorded although searches are left: it is much, or a while ago."""
        late = bool(self._sent) and now - self._unrecorded_since >= UNRECORDED_S
        return late or len(self._sent) >= MOST_UNRECORDED

    def take_over(self, most: int) -> bool:
        """Record the oldest of what was added, `most` publications at most; return whether others are left."""
        sent, self._sent = self._sent[:most], self._sent[most:]
        for publication in sent:
            message = publication.message
            if isinstance(message, RobotPath):
                self._record_path(publication.ids["robot"], message)
            elif isinstance(message, RobotRelease):
                self._record_release(publication.ids["robot"], message)
        return bool(self._sent)

    def _record_path(self, robot: str, path: RobotPath) -> None:
        """Record what the API shows, and report a plan when it is first published, a refusal when it changes."""
        before = self.paths.get(robot)
        self.paths[robot] = path
        if before is not None and (before.plan_id, before.refusal) == (path.plan_id, path.refusal):
            return
        if before is None or before.plan_id != path.plan_id:
            for trace in path.traces:
                metrics.observe_trace(trace, ["plan"])
        if path.refusal is not None:
            _log.warning("plan_refused", robot=robot, plan=path.plan_id, reason=path.refusal.reason)
        else:
            _log.info("plan_published", robot=robot, plan=path.plan_id, corners=len(path.points), map_seq=path.map_seq,
                      hazards=[trace.area for trace in path.traces])  # fmt: skip

    def _record_release(self, robot: str, release: RobotRelease) -> None:
        if (path := self.paths.get(robot)) is not None:
            self.paths[robot] = path.after(release)
