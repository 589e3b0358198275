"""A peer of ROS 2 on DDS that reads keepout masks, for `fognav bench pipeline --ros2 --wire dds`.

It is Cyclone DDS, as the bridge's side is; the masks are read as those of the zenoh wire are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from cyclonedds.core import Listener
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.idl.annotations import final
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

if TYPE_CHECKING:
    from collections.abc import Callable

LOOPBACK: Final = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>"
    '<Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
)
"""A configuration of Cyclone DDS (CYCLONEDDS_URI): within this computer."""


def _struct(name: str, **fields: Any) -> type[IdlStruct]:  # noqa: ANN401  # Cyclone's annotations
    package, _, short = name.partition("/")
    made: type[IdlStruct] = final(make_idl_struct(short, f"{package}::msg::dds_::{short}_", fields))
    return made


def _grid() -> type[Any]:
    """Return the type of a grid, whose samples are read as their bytes: Cyclone's own reader takes 0.1 s for a mask."""
    time = _struct("builtin_interfaces/Time", sec=idl.int32, nanosec=idl.uint32)
    axes = dict.fromkeys("xyz", idl.float64)
    pose = _struct(
        "geometry_msgs/Pose",
        position=_struct("geometry_msgs/Point", **axes),
        orientation=_struct("geometry_msgs/Quaternion", **axes, w=idl.float64),
    )
    info = _struct(
        "nav_msgs/MapMetaData", map_load_time=time, resolution=idl.float32, width=idl.uint32, height=idl.uint32,
        origin=pose,
    )  # fmt: skip
    header = _struct("std_msgs/Header", stamp=time, frame_id=str)
    cells = idl.sequence.__class_getitem__(idl.int8)  # type: ignore[no-untyped-call]  # sequence[int8], which mypy does not see
    made: Any = _struct("nav_msgs/OccupancyGrid", header=header, info=info, data=cells)

    def read(kind: type[Any], /, data: bytes, **_: object) -> Any:  # noqa: ANN401  # of the class above
        sample = object.__new__(kind)
        sample.payload = data
        return sample

    made.deserialize = classmethod(read)
    found: type[Any] = made
    return found


class Reader:
    """Reads the latched grids on a topic of ROS."""

    def __init__(self, domain: int, topic: str, on_grid: Callable[[bytes], object]) -> None:
        """Call `on_grid` with the CDR of each grid, on a thread of Cyclone's."""
        self._domain = Domain(domain, LOOPBACK)
        self._participant = DomainParticipant(domain)
        quality = Qos(
            Policy.Reliability.Reliable(max_blocking_time=0), Policy.Durability.TransientLocal,
            Policy.History.KeepLast(1), Policy.DataRepresentation(use_cdrv0_representation=True),
        )  # fmt: skip

        def on_data(reader: DataReader[Any]) -> None:
            for sample in reader.take(10):
                if (data := getattr(sample, "payload", None)) is not None:
                    on_grid(data)

        self._reader: DataReader[Any] = DataReader(
            self._participant, Topic(self._participant, f"rt/{topic}", _grid()), qos=quality,
            listener=Listener(on_data_available=on_data),  # type: ignore[no-untyped-call]  # Cyclone's
        )  # fmt: skip
