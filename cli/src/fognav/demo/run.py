"""A demonstration from start to outcome: attempts, each slower than the last, until the machine sustains the speed."""

import asyncio
from collections.abc import Callable, Sequence

import msgspec

from fog_contracts.stages import durations_ms, hazard_to_path_ms
from fog_runtime.configuration.site import LoadedSite
from fognav.demo.attempt import Attempt
from fognav.demo.machine import TooFastError
from fognav.demo.options import DrivePlan, Options
from fognav.demo.scene import Scene
from fognav_sim.drive.drive import DriveOutcome


def modes(attempt: Attempt) -> dict[str, int]:
    """Return how often the robot entered each mode on its drive."""
    return dict(attempt.drive.evaluation.modes) if attempt.drive is not None else {}


def report(attempt: Attempt, given_up: Sequence[dict[str, object]]) -> dict[str, object]:
    """Summarize the last attempt; `given_up` lists the attempts before it that could not sustain their speed."""
    return {
        **_drive(attempt),
        "processes": attempt.usage.report(),
        "restarts": attempt.restarts,
        "modes": modes(attempt),
        "given_up": list(given_up),
        "speed": attempt.scene.speed,
        "asked_speed": attempt.plan.options.speed,
        "sustained_speed": attempt.speed_watch.sustained,
        "events": [f"{at:.1f} {text}" for at, text in attempt.scene.events],
    }


def _drive(attempt: Attempt) -> dict[str, object]:
    options = attempt.plan.options
    trace = attempt.placement.trace() if attempt.placement is not None else None
    return {
        **msgspec.structs.asdict(attempt.summary()),
        "site": attempt.plan.site.site.id,
        "base": options.base,
        "lidar": options.lidar,
        "seed": options.seed,
        "hazard": attempt.plan.hazard,
        "stages_ms": durations_ms(trace),
        **({} if attempt.guest is None else {"guest": attempt.guest, "success": attempt.success()}),
        "hazard_to_path_ms": hazard_to_path_ms(trace),
    }


class Demo:
    """A demonstration; `scene` is that of the current attempt."""

    def __init__(self, site: LoadedSite, options: Options, on_event: Callable[[str], None] | None = None) -> None:
        """Plan the drive; raises `WrongUseError` for a site without a demo."""
        self.site = site
        self.plan = DrivePlan.of(site, options)
        self.page_url = ""
        self._on_event = on_event
        self._given_up: list[dict[str, object]] = []
        self.attempt = self._new_attempt(options.speed)

    @property
    def scene(self) -> Scene:
        """The scene of the current attempt."""
        return self.attempt.scene

    def _new_attempt(self, speed: float) -> Attempt:
        scene = Scene(self.site, self.plan.robot, self.plan.options.seed, speed, page_url=self.page_url)
        scene.on_event = self._on_event
        return Attempt(self.plan, scene)

    async def run(self, stop: asyncio.Event) -> dict[str, object]:
        """Run until the outcome, or until `stop` is set; return the report. All processes have ended on return.

        Raises `NotReadyError` if a process does not start, and `WrongUseError` if the site is not suitable.
        """
        speed = self.plan.options.speed
        self._given_up.clear()
        while True:
            self.attempt = self._new_attempt(speed)
            try:
                await self._until_stop(self.attempt, stop)
            except TooFastError as slow:
                slower = slow.lower(speed)
                self._given_up.append({"speed": speed, "reason": str(slow), "modes": modes(self.attempt)})
                self.scene.log_event(
                    f"this machine can't sustain speed {speed:g} ({slow}): starting again at speed {slower:g}"
                )
                speed = slower
                continue
            return self.report()

    async def _until_stop(self, attempt: Attempt, stop: asyncio.Event) -> None:
        running = asyncio.create_task(attempt.run(stop))
        stopped = asyncio.create_task(stop.wait())
        try:
            await asyncio.wait({running, stopped}, return_when=asyncio.FIRST_COMPLETED)
            # An attempt that keeps running handles the stop itself.
            if not running.done() and attempt.scene.outcome is None:
                attempt.end(DriveOutcome("stopped", "interrupted; ending all processes"))
                running.cancel()
            await asyncio.wait({running})
            if not running.cancelled():
                running.result()
        finally:
            stopped.cancel()
            running.cancel()
            await asyncio.gather(running, stopped, return_exceptions=True)

    def report(self) -> dict[str, object]:
        """Return the report of the last attempt, with those that were given up."""
        return report(self.attempt, self._given_up)
