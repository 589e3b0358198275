"""The parts of the robot whose tests are tested: their modules, their tests, and the mutants that change nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from fognav.output import WrongUseError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from fognav_experiments.mutation.mutants import Mutant

LEAST_SCORE: Final = 0.9
"""Share of the mutants that the tests of a part must notice, those that change nothing left out."""


class Equivalent(NamedTuple):
    """A mutant that no test can notice: the module's last name, code and change as the report prints them, and why."""

    module: str
    code: str
    change: str
    reason: str


class Part(NamedTuple):
    """A part of the robot.

    modules: names below `robot_agent`; a package stands for all its modules. tests: files or folders below
    `robot-agent/tests`. preload: what the tests import besides these modules and is the same for every mutant.
    """

    name: str
    modules: tuple[str, ...]
    tests: tuple[str, ...]
    preload: tuple[str, ...]
    equivalent: tuple[Equivalent, ...] = ()

    def why_equivalent(self, module: str, mutant: Mutant) -> str | None:
        """Return why no test can notice this mutant; None for one that tests must notice."""
        last, change = module.rpartition(".")[2], f"{mutant.before} -> {mutant.after}"
        for known in self.equivalent:
            if (known.module, known.code, known.change) == (last, mutant.code, change):
                return known.reason
        return None

    def files(self, root: Path) -> dict[str, Path]:
        """Return the source of each module, by its full name, in a checkout."""
        package = root / "robot-agent/src/robot_agent"
        found: dict[str, Path] = {}
        for name in self.modules:
            path = package.joinpath(*name.split("."))
            files = sorted(path.glob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
            for file in files:
                if file.stem != "__init__":
                    found[".".join(("robot_agent", *file.relative_to(package).with_suffix("").parts))] = file
        return found


def parts_named(names: Sequence[str]) -> list[Part]:
    """Return the parts of these names, or all; raises `WrongUseError` for an unknown name."""
    known = {part.name: part for part in PARTS}
    for name in names:
        if name not in known:
            raise WrongUseError(f"there is no part {name!r}: name one of {', '.join(known)}")
    return [known[name] for name in names] or list(PARTS)


_LOOKING_AROUND: Final = (
    'inputs, localization="good", inside_blocked=inside, map_loaded=True, map_age=0.0, map_gap=0.0, mission=False'
)
PARTS: Final = (
    Part(
        "safety",
        ("safety",),
        ("safety",),
        ("numpy", "hypothesis.strategies", "fog_kernels.sweep", "robot_agent.config", "robot_agent.footprint"),
        (
            Equivalent(
                "stop_field",
                "turns = np.asarray(angles) / math.tau + 0.5",
                "np.asarray(angles) / math.tau + 0.5 -> np.asarray(angles) / math.tau - 0.5",
                "whole turns are taken off afterwards",
            ),
            Equivalent(
                "stop_field",
                "sectors: NDArray[np.int64] = np.floor((turns - np.floor(turns)) * SECTORS).astype(np.int64) % SECTORS",
                "turns - np.floor(turns) -> turns + np.floor(turns)",
                "whole turns more are whole circles of sectors, which the remainder takes off",
            ),
            Equivalent(
                "stop_field",
                "SECTOR_ANGLES: Final = np.array("
                "[(sector + 0.5) * math.tau / SECTORS - math.pi for sector in range(SECTORS)])",
                "(sector + 0.5) * math.tau / SECTORS - math.pi -> (sector + 0.5) * math.tau / SECTORS + math.pi",
                "directions that differ by whole turns are the same",
            ),
            *(
                Equivalent(
                    "stop_field", code, "twist.v > 0.0 -> twist.v >= 0.0", "a robot that does not advance is let pass"
                )
                for code in (
                    "heading = lead if twist.v > 0.0 else math.pi - lead",
                    'side = "ahead" if twist.v > 0.0 else "behind"',
                )
            ),
            *(
                Equivalent(
                    "maneuver",
                    f"return {words}, {done}",
                    f"{done} -> {not done}",
                    "a robot is disabled after an egress, a turn and an advance, done or not",
                )
                for words, done in (
                    ('"the robot is out"', True),
                    ('f"the way out ends, and the robot is still in {still}"', False),
                    ('"the robot knows where it is"', True),
                    ("ahead", False),
                    ('f"it is done, and the pose is {_POSE_WORDS[inputs.localization]}{detail}"', True),
                )
            ),
            *(
                Equivalent(
                    "maneuver",
                    code,
                    change,
                    "conditions ask for what is worse than good, and for more than a second",
                )
                for code, change in (
                    ('localization="good",', "'good' -> 'goodX'"),
                    ("map_age=0.0,", "0.0 -> 1.0"),
                    ("map_gap=0.0,", "0.0 -> 1.0"),
                    (_LOOKING_AROUND, "'good' -> 'goodX'"),
                    (_LOOKING_AROUND, "0.0 -> 1.0"),
                )
            ),
        ),
    ),
    Part(
        "guardian",
        (
            "guardian.awakening",
            "guardian.base_reports",
            "guardian.core",
            "guardian.link",
            "guardian.maneuvers",
            "guardian.timing",
        ),
        (
            "guardian/test_awakening.py",
            "guardian/test_guardian_core.py",
            "guardian/test_guardian_limits.py",
            "guardian/test_guardian_maneuvers.py",
            "guardian/test_guardian_moments.py",
            "guardian/test_guardian_self_driving.py",
            "guardian/test_timing.py",
        ),
        ("numpy", "hypothesis.strategies", "robot_agent.config"),
        (
            Equivalent(
                "maneuvers",
                '"seek_dock": Limit(60.0, 5.0, 0.0),',
                "0.0 -> 1.0",
                "a base that seeks its dock is told no wheel speeds",
            ),
            Equivalent(
                "core",
                "elapsed = 0.0 if self._stepped_at is None else max(0.0, min(now - self._stepped_at, STEP_S))",
                "0.0 -> 1.0",
                "the first of the two: a base that is awake has a time of its last step",
            ),
            Equivalent(
                "core",
                "moved: bool = False",
                "False -> True",
                "a base is awake only after it was woken, which sets it",
            ),
            Equivalent(
                "core",
                "if status is base.harmless and base.awake and self._maneuvers.running is None:",
                "self._maneuvers.running is None -> self._maneuvers.running is not None",
                "a status that is no fault without a maneuver is none during one: it is only asked again",
            ),
            Equivalent(
                "core",
                "base.harmless = None if lasting else status",
                "base.harmless = None if lasting else status -> pass",
                "it saves asking a status again that is no fault, and changes no answer",
            ),
            Equivalent(
                "core",
                "if current * target < 0:",
                "current * target < 0 -> current * target <= 0",
                "with either of them zero, the current speed or the target is zero, and the result the same",
            ),
            Equivalent(
                "core",
                "if abs(target) <= abs(current):",
                "abs(target) <= abs(current) -> abs(target) < abs(current)",
                "a target that equals the current speed is returned by the next line, too",
            ),
            Equivalent(
                "core",
                "return min(target, current + gain) if target > 0 else max(target, current - gain)",
                "target > 0 -> target >= 0",
                "a target of zero is returned before",
            ),
        ),
    ),
    Part(
        "recoveries",
        ("motion.recovery",),
        (
            "motion/test_recovery.py",
            "motion/test_recovery_boundaries.py",
            "motion/test_recovery_limits.py",
        ),
        ("numpy", "hypothesis.strategies", "fog_kernels.clearance", "robot_agent.config"),
        (
            Equivalent(
                "recovery", "since: float = 0.0", "0.0 -> 1.0", "only a move that runs has a begin, and it sets its own"
            ),
            Equivalent(
                "recovery",
                "self._refused = False",
                "False -> True",
                "only a move that runs can be refused, and the call that begins one forgets what was before",
            ),
            *(
                Equivalent(
                    "recovery",
                    "known = _known(around, centre_x[..., None] + rim_x, centre_y[..., None] + rim_y).all(axis=2)",
                    f"centre_{axis}[..., None] + rim_{axis} -> centre_{axis}[..., None] - rim_{axis}",
                    "the points of the rim lie opposite one another",
                )
                for axis in "xy"
            ),
            Equivalent(
                "recovery",
                "_STEPS: Final = 10",
                "10 -> 11",
                "poses of the arc a centimetre apart: one more changes less than the rounding",
            ),
            *(
                Equivalent(
                    "recovery",
                    "times = np.linspace(0.0, reach, _STEPS + 1)",
                    change,
                    "poses of the arc about a centimetre apart: one more or less changes less than the rounding",
                )
                for change in ("_STEPS + 1 -> _STEPS - 1", "1 -> 2")
            ),
        ),
    ),
    Part(
        "maneuvers",
        ("agent.docking", "agent.maneuvers"),
        ("agent/test_docking.py", "agent/test_maneuvers.py"),
        ("numpy", "hypothesis.strategies", "robot_agent.localization.localizer", "robot_agent.config"),
    ),
    Part(
        "watchdog",
        ("guardian.watchdog",),
        ("guardian/test_watchdog.py",),
        ("robot_agent.serial_port", "fog_runtime.configuration.parts", "fog_runtime.machine"),
        (
            Equivalent(
                "watchdog",
                "if not os.read(heartbeat_read, 4096):",
                "4096 -> 4097",
                "only whether anything was read matters",
            ),
            Equivalent("watchdog", "speed = -1.0", "1.0 -> 1.1", "any negative number is refused"),
        ),
    ),
)
