"""A node of ROS 2 by DDS, for robots whose `RMW_IMPLEMENTATION` is rmw_fastrtps or rmw_cyclonedds (x86-64 only).

Eclipse Cyclone DDS finds the others and moves the bytes. The payloads are those of the zenoh wire, written by rosbags:
Cyclone's own serializer would take 0.1 s for a grid of 600,000 cells. Names by the design document "Topic and Service
name mapping to DDS": `rt/` and the topic's name; types in `dds_`, with an underscore.
"""

from __future__ import annotations

import asyncio
import os
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Final

from cyclonedds.core import DDSException, Listener
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.idl.annotations import final
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic
from rosbags.interfaces import Nodetype

from fog_bridges.ros2.session import RETRY_S, Arrivals, check_hash
from fog_bridges.ros2.wire import TYPES, RosMessage, Topic, dds_type, serialized, type_hash

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_runtime.clock import Clock

_UNSENT: Final = "<Watermarks><WhcHigh>256 MB</WhcHigh></Watermarks>"
"""So much may wait for a subscriber that takes nothing: more than a mask of the largest floor, so no write waits."""
_CONFIG: Final = f"<CycloneDDS><Domain><Internal>{_UNSENT}</Internal></Domain></CycloneDDS>"
_DEPTH: Final = 10
"""Messages of a topic that wait to be read, as in ROS; older ones are lost."""
_RELIABLE: Final = Policy.Reliability.Reliable(max_blocking_time=0)
_HASH: Final = b"typehash="
_BASIC: Final[dict[str, Any]] = {
    "bool": bool, "string": str, "byte": idl.uint8, "char": idl.uint8, "octet": idl.uint8,
    "float32": idl.float32, "float64": idl.float64,
    **{f"{sign}int{bits}": getattr(idl, f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)},
}  # fmt: skip


@cache
def _bytes_type(kind: str) -> type[Any]:
    """Return a message's type as Cyclone tells others of it; a sample is its bytes, `payload`, passed on as such."""
    made: type[Any] = _idl_type(kind, f"{kind.replace('/', '_')}_bytes")
    for name, function in (("serialize", _serialized), ("deserialize", classmethod(_deserialized))):
        setattr(made, name, function)
    return made


def _serialized(sample: Any, **_: object) -> bytes:  # noqa: ANN401  # of a class that is made at run time
    payload: bytes = sample.payload
    return payload


def _deserialized(kind: type[Any], /, data: bytes, **_: object) -> Any:  # noqa: ANN401  # likewise
    sample = object.__new__(kind)
    sample.payload = data
    return sample


@cache
def _idl_type(kind: str, name: str) -> type[IdlStruct]:
    """Return the structure in IDL of a message's type, as a class of that name."""
    fields = {field: _idl_field(*what) for field, what in TYPES.fielddefs[kind][1]}
    made: type[IdlStruct] = final(make_idl_struct(name, dds_type(kind), fields))
    return made


def _idl_field(node: Nodetype, what: Any) -> Any:  # noqa: ANN401  # rosbags' own tree, and what Cyclone annotates by
    if node == Nodetype.BASE:
        return _BASIC[what[0]]
    if node == Nodetype.NAME:
        return _idl_type(what, what.replace("/", "_"))
    each, length = what
    made = idl.array if node == Nodetype.ARRAY else idl.sequence
    inside = (_idl_field(*each), length) if node == Nodetype.ARRAY else _idl_field(*each)
    return made.__class_getitem__(inside)  # type: ignore[no-untyped-call]  # made[inside], which type checkers don't see


class DdsWire:
    """How a bridge reaches ROS by DDS: in a domain, on the interfaces that CYCLONEDDS_URI names."""

    def __init__(self, domain: int) -> None:
        """Enter the domain that ROS_DOMAIN_ID is for the robots; raises `ValueError` for a CYCLONEDDS_URI of no use."""
        named = os.environ.get("CYCLONEDDS_URI", "")
        try:
            self.entered = Domain(domain, ",".join(filter(None, (named, _CONFIG))))
        except DDSException as error:
            raise ValueError(f"DDS can't be used in domain {domain} ({error}); CYCLONEDDS_URI: {named!r}") from error
        self._domain = domain
        self.problem = ""

    async def opened(self, name: str, clock: Clock) -> DdsSession:
        """Return a node, whose name is not told: DDS has publishers and subscribers, and no nodes."""
        del name
        while True:
            try:
                return DdsSession(self._domain, clock)
            except DDSException as error:
                self.problem = f"domain {self._domain} of DDS can't be joined: {error}"
            await asyncio.sleep(RETRY_S)


class DdsSession(Arrivals):
    """Publishers and subscribers of ROS by DDS; handlers are called on the event loop's thread."""

    problem: Final = ""
    """DDS has no server that could be missing: who is there is there."""

    def __init__(self, domain: int, clock: Clock) -> None:
        """Join a domain."""
        super().__init__(clock)
        self._participant = DomainParticipant(domain)
        self._writers: dict[Topic, DataWriter[Any]] = {}
        self._readers: list[DataReader[Any]] = []
        self._hashes: dict[int, str] = {}

    def publish(self, topic: Topic, message: object, stamp: float) -> None:
        """Publish a message without waiting; `stamp` (s since 1970) is when."""
        if topic not in self._writers:
            made = DdsTopic(self._participant, f"rt/{topic.name}", _bytes_type(topic.type))
            self._writers[topic] = DataWriter(self._participant, made, qos=_quality(topic))
        sample = object.__new__(_bytes_type(topic.type))
        sample.payload = serialized(topic.type, message)
        try:
            self._writers[topic].write(sample, max(0, int(stamp * 1e9)))
        except DDSException as error:
            self._limited.warning("message_dropped", topic.name, self._loop.time(), topic=topic.name, reason=str(error))

    def subscribe(self, topic: Topic, handler: Callable[[RosMessage], object], max_age_s: float | None = None) -> None:
        """Call a handler with each message, as `RosSession.subscribe` does."""
        made = DdsTopic(self._participant, f"rt/{topic.name}", _bytes_type(topic.type))
        heard = Listener(on_data_available=partial(self._on_data, topic, handler, max_age_s))  # type: ignore[no-untyped-call]  # Cyclone's
        self._readers.append(DataReader(self._participant, made, qos=_quality(topic), listener=heard))

    def _on_data(
        self, topic: Topic, handler: Callable[[RosMessage], object], max_age_s: float | None, reader: DataReader[Any]
    ) -> None:
        """Pass on what has arrived: on a thread of Cyclone's."""
        for sample in reader.take(_DEPTH):
            if (data := getattr(sample, "payload", None)) is None:
                continue  # a publisher has left
            info = sample.sample_info
            theirs = self._hash_of(reader, info.publication_handle)
            self.arrive(topic, len(data), partial(self._read, topic, handler, max_age_s, data, theirs, info))

    def _read(  # what a sample consists of
        self, topic: Topic, handler: Callable[[RosMessage], object], max_age_s: float | None,
        data: bytes, theirs: str, info: Any,  # noqa: ANN401  # Cyclone's, which has no types
    ) -> None:  # fmt: skip
        if theirs:
            check_hash(topic.type, theirs)
        self.hand_on(topic, handler, max_age_s, info.source_timestamp / 1e9, data)

    def _hash_of(self, reader: DataReader[Any], publication: int) -> str:
        """Return the hash of its type that a publisher names, as ROS's do from Iron on; empty for others."""
        if publication not in self._hashes:
            found = reader.get_matched_publication_data(publication)
            told = next((p.data for p in found.qos if isinstance(p, Policy.Userdata)), b"") if found else b""
            self._hashes[publication] = told.partition(_HASH)[2].partition(b";")[0].decode("ascii", "replace")
        return self._hashes[publication]

    def close(self) -> None:
        """Leave the domain."""
        self._writers.clear()
        self._readers.clear()
        del self._participant


def _quality(topic: Topic) -> Qos:
    """Return the quality of service of ROS's default, or of what it calls latched, with the hash of the type."""
    kept = Policy.History.KeepLast(1 if topic.latched else _DEPTH)
    lasting = Policy.Durability.TransientLocal if topic.latched else Policy.Durability.Volatile
    return Qos(
        _RELIABLE, lasting, kept, Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(_HASH + type_hash(topic.type).encode() + b";"),
    )  # fmt: skip
