"""The relay before a server, where its connections end."""

import asyncio

from fog_runtime import relay


class Gone(asyncio.Transport):
    """As asyncio's encrypted transport in Python 3.11.2: once its connection is lost, it can't be aborted."""

    aborted = 0
    lost = False

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def close(self) -> None:
        pass

    def abort(self) -> None:
        assert not self.lost
        self.aborted += 1


async def connections(monkeypatch):
    monkeypatch.setattr(relay, "_FLUSH_S", 0.0)
    ends = relay._End(), relay._End()
    for end, other in zip(ends, reversed(ends), strict=True):
        end.other = other
        end.connection_made(Gone())
    return ends


async def test_connection_that_is_lost_after_its_other_end_is_not_ended_again(monkeypatch):
    errors = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context))
    server, client = await connections(monkeypatch)
    transport = client.transport
    server.connection_lost(None)
    transport.lost = True
    client.connection_lost(None)
    await asyncio.sleep(0.01)
    assert errors == []


async def test_connection_that_does_not_take_what_is_left_is_ended_after_its_other_end(monkeypatch):
    server, client = await connections(monkeypatch)
    server.connection_lost(None)
    await asyncio.sleep(0.01)
    assert client.transport.aborted == 1
