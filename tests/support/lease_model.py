"""The model of the lease in Redis, for the tests of all that is built on it."""

from fog_runtime.lease import HANDED_KNOWN_S, HANDED_PAUSE_S, Granted, Held, LeftToOther

LEASE_S = 1.2
READY_SAID_S = 0.45


class LeaseModel:
    """Grants leases in memory as the script of `lease_store` does in Redis; `test_lease_store` compares the two."""

    def __init__(self) -> None:
        self.stored = self.floor = 0
        self.lease: tuple[int, str, float] | None = None
        self.ready: tuple[str, float] | None = None
        self.handed: list[float] = []
        """When leases were taken because their holder was late."""

    def may_take(self, now: float) -> bool:
        if not self.handed or now - self.handed[-1] >= HANDED_KNOWN_S:
            self.handed.clear()
            return True
        return now - self.handed[-1] >= HANDED_PAUSE_S * 2 ** (len(self.handed) - 1)

    def acquire(self, holder: str, request, now: float, clock: int = 0):
        held = self.lease if self.lease is not None and now < self.lease[2] else None
        taken = False
        if held is not None and held[1] != holder:
            if request.ready:
                self.ready = (holder, now + READY_SAID_S)
            taken = request.ready and request.late == held[0] and self.may_take(now)
            if not taken:
                self.floor = max(self.floor, request.floor if request.floor > held[0] else 0)
                return Held(held[0], held[1], held[2] - now)
            self.handed.append(now)
            held = None
        ready = self.ready if self.ready is not None and now < self.ready[1] else None
        if ready is not None and ready[0] != holder and request.cut_off:
            self.lease = None
            return LeftToOther(ready[0])
        epoch, confirmed = request.epoch, request.confirmed
        if epoch == 0 and held is not None:
            epoch, confirmed = held[0], True
        floor = max(request.floor, self.floor)
        if epoch <= floor or epoch < self.stored or (epoch == self.stored and not confirmed):
            epoch = max(self.stored + 1, floor + 1, clock)
        self.stored = epoch
        self.lease = (epoch, holder, now + LEASE_S)
        return Granted(epoch, taken=taken)
