"""Files that survive a restart: the last trusted pose, and the last snapshot of the map for offline starts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from fog_contracts.messages import MapSnapshot
from fog_runtime import logs
from fog_runtime.files import atomic_write
from robot_agent.localization.pose import SavedPose

if TYPE_CHECKING:
    from pathlib import Path

_log = logs.get("store")
_snapshots = msgspec.msgpack.Decoder(MapSnapshot)
_poses = msgspec.json.Decoder(SavedPose)


class Store:
    """Two files in the robot's data folder; each write replaces a file as a whole. All methods block."""

    def __init__(self, folder: Path) -> None:
        self._pose = folder / "pose.json"
        self._snapshot = folder / "snapshot.msgpack"

    def pose(self, site: str) -> SavedPose | None:
        """Return the stored pose on this site, None without a valid one."""
        data = _read(self._pose)
        if data is None:
            return None
        try:
            saved = _poses.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            _log.warning("stored_pose_refused", file=str(self._pose), reason=str(error))
            return None
        return saved if saved.site == site else None

    def put_pose(self, saved: SavedPose) -> None:
        """Store a pose; raises `OSError`."""
        atomic_write(self._pose, msgspec.json.encode(saved))

    def snapshot(self, site: str) -> MapSnapshot | None:
        """Return the stored map of this site, None without a readable one (its hash is not checked)."""
        data = _read(self._snapshot)
        if data is None:
            return None
        try:
            snapshot = _snapshots.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            _log.warning("stored_map_refused", file=str(self._snapshot), reason=str(error))
            return None
        return snapshot if snapshot.site == site else None

    def put_snapshot(self, snapshot: MapSnapshot) -> None:
        """Store a map; raises `OSError`."""
        atomic_write(self._snapshot, msgspec.msgpack.encode(snapshot))


def _read(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        _log.warning("file_not_readable", file=str(file), reason=str(error))
        return None
