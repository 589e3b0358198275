"""What the simulator can be told."""

from pathlib import Path

from fog_runtime.settings import CommonSettings


class Settings(CommonSettings, frozen=True, kw_only=True):
    """FOGNAV_RUN_DIR: folder of the devices `roomba` and `lidar`; FOGNAV_TRUTH_LOG: file for what is really so."""

    run_dir: Path
    robot: str = ""
    """Id of the robot in `site.toml`; empty: its first."""
    seed: int = 1
    truth_log: Path | None = None
