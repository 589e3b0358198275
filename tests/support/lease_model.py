"""The model of the lease in Redis, for the tests of all that is built on it."""

from fog_runtime.lease import Granted, Held, LeftToOther

LEASE_S = 1.2
READY_SAID_S = 0.45


class LeaseModel:
    """Grants leases in memory as the script of `lease_store` does in Redis; `test_lease_store` compares the two."""

    def __init__(self) -> None:
        self.stored = self.floor = 0
        self.lease: tuple[int, str, float] | None = None
        self.ready: tuple[str, float] | None = None

    def acquire(self, holder: str, request, now: float, clock: int = 0):
        held = self.lease if self.lease is not None and now < self.lease[2] else None
        if held is not None and held[1] != holder:
            if request.ready:
                self.ready = (holder, now + READY_SAID_S)
            self.floor = max(self.floor, request.floor if request.floor > held[0] else 0)
            return Held(held[0], held[1], held[2] - now)
        ready = self.ready if self.ready is not None and now < self.ready[1] else None
        if request.cut_off and ready is not None and ready[0] != holder:
            self.lease = None
            return LeftToOther()
        epoch, confirmed = request.epoch, request.confirmed
        if epoch == 0 and held is not None:
            epoch, confirmed = held[0], True
        floor = max(request.floor, self.floor)
        if epoch <= floor or epoch < self.stored or (epoch == self.stored and not confirmed):
            epoch = max(self.stored + 1, floor + 1, clock)
        self.stored = epoch
        self.lease = (epoch, holder, now + LEASE_S)
        return Granted(epoch)
