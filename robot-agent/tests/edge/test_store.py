from __future__ import annotations

import msgspec
import pytest
from little_world import LittleWorld

from robot_agent.agent.edges.map_loader import Store
from robot_agent.localization.pose import SavedPose

POSE = SavedPose(site="lab", x=1.0, y=2.0, theta=0.5, sigma_xy=0.1, sigma_theta=0.05)


def test_stored_pose_and_map_are_returned_for_their_own_site_only(tmp_path):
    store, snapshot = Store(tmp_path / "data"), LittleWorld().master.snapshot()
    assert store.pose("lab") is None
    assert store.snapshot("lab") is None
    store.put_pose(POSE)
    store.put_snapshot(snapshot)
    assert store.pose("lab") == POSE
    assert store.pose("other") is None
    assert store.snapshot("lab") == snapshot
    assert store.snapshot("other") is None


@pytest.mark.parametrize("damage", [b"", b"\xff\xfe", b"{}", b"[" * 10])
def test_damaged_files_count_as_missing(tmp_path, damage):
    store = Store(tmp_path)
    store.put_pose(POSE)
    store.put_snapshot(LittleWorld().master.snapshot())
    for file in tmp_path.iterdir():
        file.write_bytes(damage)
    assert store.pose("lab") is None
    assert store.snapshot("lab") is None


def test_a_pose_that_is_no_number_is_refused(tmp_path):
    (tmp_path / "pose.json").write_bytes(msgspec.json.encode(POSE).replace(b"1.0", b"null"))
    assert Store(tmp_path).pose("lab") is None
