"""The lease of a service in Redis: one script grants it, renews it, and lets its holder leave it to another one."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Final, Self

from fog_runtime.credentials import NOBODY
from fog_runtime.lease import (
    ATTEMPT_S,
    HANDED_KNOWN_S,
    HANDED_PAUSE_S,
    LEASE_S,
    READY_SAID_S,
    Granted,
    Held,
    LeftToOther,
    Reply,
    Request,
)
from fog_runtime.stores.redis_connection import RedisConnection, StoreError

if TYPE_CHECKING:
    from fog_runtime.credentials import Credentials
    from fog_runtime.stores.redis_connection import Command

# The lease is "EPOCH HOLDER" and expires; the epoch stays. An epoch that Redis has granted is renewed as long as nobody
# drew another one, even if the lease expired or Redis lost it meanwhile; a provisional one must be above every other.
# Whoever asks in vain, but knows of a higher epoch than the leader's, leaves that in Redis (the floor), and the leader
# draws one above it at its next renewal. Else nobody might tell it of a provisional epoch that receivers heard, and
# they would refuse it for ever.
# A standby that has what it needs to lead leaves its name for a moment (ready). A leader that is cut off from what it
# needs finds it, and gives the lease back.
# A standby that finds the leader late, and would be quicker, takes the lease: what the leader asks Redis may be late,
# too. The more often that happened, the longer nobody does it again (handed).
# The clock (ms) only keeps epochs growing that Redis and all who could know have forgotten.
_ACQUIRE: Final = """
local holder, epoch, floor, confirmed = ARGV[1], tonumber(ARGV[2]), tonumber(ARGV[3]), ARGV[4] == '1'
local stored = tonumber(redis.call('GET', KEYS[2]) or '0')
local lease = redis.call('GET', KEYS[1])
local held_epoch, held_by
if lease then held_epoch, held_by = string.match(lease, '^(%d+) (.*)$') end
local left = tonumber(redis.call('GET', KEYS[3]) or '0')
local ready, cut_off, taken = ARGV[7] == '1', ARGV[8] == '1', false
if held_by and held_by ~= holder then
  if ready then redis.call('SET', KEYS[4], holder, 'PX', ARGV[9]) end
  local handed = tonumber(redis.call('GET', KEYS[5]) or '0')
  local since = tonumber(ARGV[12]) - redis.call('PTTL', KEYS[5])
  local may = handed == 0 or since >= tonumber(ARGV[11]) * 2 ^ (handed - 1)
  taken = ready and may and ARGV[10] == held_epoch
  if not taken then
    if floor > math.max(left, tonumber(held_epoch)) then redis.call('SET', KEYS[3], string.format('%.0f', floor)) end
    return {0, held_epoch, held_by, redis.call('PTTL', KEYS[1])}
  end
  redis.call('SET', KEYS[5], handed + 1, 'PX', ARGV[12])
end
local successor = redis.call('GET', KEYS[4])
if successor == holder then successor = nil end
if cut_off and successor then
  redis.call('DEL', KEYS[1])
  return {2, successor}
end
floor = math.max(floor, left)
if epoch == 0 and held_by and not taken then epoch, confirmed = tonumber(held_epoch), true end
if epoch <= floor or epoch < stored or (epoch == stored and not confirmed) then
  epoch = math.max(stored + 1, floor + 1, tonumber(ARGV[5]))
end
local text = string.format('%.0f', epoch)
if epoch ~= stored then redis.call('SET', KEYS[2], text) end
redis.call('SET', KEYS[1], text .. ' ' .. holder, 'PX', ARGV[6])
return {1, text, taken and 1 or 0}
"""
_GRANTED, _LEFT_TO_OTHER = 1, 2
_RELEASE: Final = """
local lease = redis.call('GET', KEYS[1])
if lease and string.match(lease, '^%d+ (.*)$') == ARGV[1] then return redis.call('DEL', KEYS[1]) end
return 0
"""


class LeaseStore:
    """The lease of one service of a site; none of its calls raises for a Redis that does not answer."""

    def __init__(self, url: str, site: str, service: str, *, credentials: Credentials = NOBODY) -> None:
        self._redis = RedisConnection(url, timeout_s=ATTEMPT_S, credentials=credentials)
        names = ("lease", "epoch", "floor", "ready", "handed")
        self._keys = tuple(f"fog:{site}:{service}:{name}" for name in names)

    async def __aenter__(self) -> Self:
        """Return the store; it connects with the first command."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connections."""
        await self._redis.aclose()

    async def acquire(self, holder: str, request: Request) -> Reply:
        """Take or renew the lease; None when Redis did not answer in time: it may have done it all the same."""
        arguments = (
            holder, request.epoch, request.floor, int(request.confirmed), _now_ms(), round(LEASE_S * 1000),
            int(request.ready), int(request.cut_off), round(READY_SAID_S * 1000),
            request.late, round(HANDED_PAUSE_S * 1000), round(HANDED_KNOWN_S * 1000),
        )  # fmt: skip
        reply = await self._attempt(("EVAL", _ACQUIRE, len(self._keys), *self._keys, *arguments))
        match reply:
            case None:
                return None
            case [outcome, successor] if outcome == _LEFT_TO_OTHER:
                return LeftToOther(successor.decode("utf-8", "replace"))
            case [outcome, epoch, taken] if outcome == _GRANTED:
                return Granted(int(epoch), taken=bool(taken))
            case [_, epoch, other, remaining_ms]:
                return Held(int(epoch), other.decode("utf-8", "replace"), max(0, remaining_ms) / 1000)
        raise AssertionError(f"the script returned {reply!r}")

    async def release(self, holder: str) -> None:
        """Give the lease back, if this process holds it, so that another takes over at once; else it expires."""
        await self._attempt(("EVAL", _RELEASE, 1, self._keys[0], holder))

    async def _attempt(self, command: Command) -> Any:  # noqa: ANN401  # redis does not type its replies
        """Execute a command once, in at most `ATTEMPT_S`; None when Redis did not answer, or refused it."""
        try:
            async with asyncio.timeout(ATTEMPT_S):
                (reply,) = await self._redis.write(command)
        except (StoreError, TimeoutError):
            return None
        return reply


def _now_ms() -> int:
    return int(time.time() * 1000)
