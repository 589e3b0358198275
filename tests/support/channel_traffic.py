"""Processes of a fog as the channel table describes them: what each publishes and receives, and what has arrived."""

from __future__ import annotations

import asyncio
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.messages import Message

    Publish = Callable[["Process", Channel, "Ids"], Awaitable[object]]

Ids = dict[str, str]
Key = tuple[tuple[str, str], ...]

WAIT_S: Final = 60.0
MANY: Final = 30
"""Messages that are awaited of each: a publisher that learned of no subscription sends some before it asks."""
PAUSE_S: Final = 0.02
ROBOTS: Final = ("r1", "r2")
NODES: Final = ("n1", "n2")
SOURCES: Final = ("cleaning", "doors")
AREAS: Final = ("hall", "lift")
NUMBER: Final = "3"
"""Of an area on the thesis's topics."""
SERVICES: Final = (ch.AGGREGATOR, ch.MAP, ch.PLANNER)
ONE_ROBOT: Final = "one robot"
"""The copy of a tool that follows the first robot alone, as the demo's operator does."""


async def until(condition: Callable[[], object], details: Callable[[], object]) -> None:
    """Wait until a condition is true; after the deadline, fail with the details."""
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, details()
        await asyncio.sleep(PAUSE_S)


@dataclass(frozen=True)
class Process:
    """Who takes part: a role, as which user, and which copy of it."""

    role: str
    user: str
    copy: str = ""

    def publications(self, rows: Iterable[Channel]) -> list[tuple[Channel, Ids]]:
        """Return (channel, ids) of everything that this process publishes."""
        return [(row, ids) for row in rows if self.role in row.publishers for ids in self._published_ids(row)]

    def _published_ids(self, row: Channel) -> list[Ids]:
        values: dict[str, Sequence[str]] = {
            "robot": (self.user,) if self.role == ch.ROBOT else ROBOTS,
            "node": (self.user,) if self.role == ch.NODE else NODES,
            "source": (self.user,) if self.role == ch.ZONE_SOURCE else SOURCES,
            "zone": ("wet",),
            "thing": ("tb4",),
            "lift": ("north",),
            "set": ("night",),
            "area": AREAS,
            "role": (self.role,),
            "number": (NUMBER,),
            "robot_device": ("robot_r1",),
        }
        ids: list[Ids] = [{}]
        for field in row.fields:
            if field != "site":
                ids = [{**each, field: value} for each in ids for value in values[field]]
        return ids

    def subscriptions(self, rows: Iterable[Channel]) -> list[tuple[Channel, Ids]]:
        """Return (channel, ids) of every subscription that this process makes, ids as given to the edge."""
        wanted = [row for row in rows if self.role in row.subscribers or self.role == "recorder"]
        return [(row, self._own(row)) for row in wanted]

    def _own(self, row: Channel) -> Ids:
        if self.role == ch.ROBOT and "robot" in row.fields:
            return {"robot": self.user}
        return {"robot": "r1"} if self.copy == ONE_ROBOT and "robot" in row.fields else {}

    def receives(self, row: Channel, ids: Ids) -> bool:
        """Whether something published with these ids is for this process."""
        if self.role == ch.NODE and ids.get("node", self.user) != self.user:
            return False
        if self.role == ch.ZONE_SOURCE and ids.get("source", self.user) != self.user:
            return False
        return any(row == each and own.items() <= ids.items() for each, own in self.subscriptions([row]))


def frozen(ids: Ids) -> Key:
    """Return ids as a key of a dict."""
    return tuple(sorted(ids.items()))


Arrival = tuple[Process, str, Key]
"""Where something arrived, on which channel and with which ids."""


class Traffic:
    """What arrived where, of what the processes publish."""

    def __init__(self) -> None:
        self.found: Counter[Arrival] = Counter()
        self.messages: defaultdict[Arrival, list[Message | str]] = defaultdict(list)

    def receiver(self, process: Process, row: Channel) -> Callable[[Ids, Message | str], None]:
        """Return the handler of a subscription."""

        def receive(ids: Ids, message: Message | str) -> None:
            each = (process, row.name, frozen(ids))
            self.found[each] += 1
            self.messages[each].append(message)

        return receive

    async def until_all_arrive(
        self, publishing: Sequence[Process], subscribing: Sequence[Process], publish: Publish, rows: Sequence[Channel]
    ) -> set[str]:
        """Let `publish(process, row, ids)` be called again and again, until many of each message are wherever due.

        Returns the channels that arrived at somebody.
        """
        self.found.clear()
        sent = [(process, row, ids) for process in publishing for row, ids in process.publications(rows)]
        due = {
            (other, row.name, frozen(ids)) for _, row, ids in sent for other in subscribing if other.receives(row, ids)
        }
        deadline = time.monotonic() + WAIT_S
        while missing := {each: self.found[each] for each in due if self.found[each] < MANY}:
            assert time.monotonic() < deadline, missing
            for process, row, ids in sent:
                await publish(process, row, ids)
            await asyncio.sleep(PAUSE_S)
        assert set(self.found) == due, "nobody receives what is not for him"
        return {name for _, name, _ in due}


def copies(*names: str) -> list[Process]:
    """Return copies of each service with these names."""
    return [Process(role, role, name) for role in SERVICES for name in names]
