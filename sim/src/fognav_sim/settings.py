"""Settings of the simulator."""

from pathlib import Path

from fog_runtime.default_parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.settings import CommonSettings


class Settings(CommonSettings, frozen=True, kw_only=True):
    """FOGNAV_RUN_DIR: folder of the devices `base` and `lidar`; FOGNAV_TRUTH_LOG: file for the ground truth."""

    run_dir: Path
    robot: str = ""
    """Id of the robot in `site.toml`; empty: the first."""
    base: str = DEFAULT_BASE
    """The robot's base: a name in the entry points `fognav.base_emulators`."""
    lidar: str = DEFAULT_LIDAR
    """The robot's lidar: a name in the entry points `fognav.lidar_emulators`."""
    seed: int = 1
    truth_log: Path | None = None
