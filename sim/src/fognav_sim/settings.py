"""Settings of the simulator."""

from pathlib import Path
from typing import Literal

from fog_runtime.configuration.settings import CommonSettings
from fog_runtime.credentials import NOBODY, Credentials


class Settings(CommonSettings, frozen=True, kw_only=True):
    """FOGNAV_RUN_DIR: folder of the devices `base` and `lidar`; FOGNAV_TRUTH_LOG: file for the ground truth.

    The robot's hardware, and the lidar's place on it, are those of its robot file
    (`fog_runtime.configuration.robot_file`).
    """

    run_dir: Path
    robot: str = ""
    """Id of the robot in `site.toml`; empty: the first."""
    nodes: Literal["auto", "firmware", "model"] = "auto"
    """What the sensor nodes run: the firmware's core, compiled for this computer, or a model of it in Python.
    `auto`: the firmware where its sources and a C++ compiler are."""
    seed: int = 1
    truth_log: Path | None = None
    node_credentials_dir: Path | None = None
    """Folder with the credentials of each sensor node, `NODE.toml`; without it the nodes are nobody."""

    def credentials_of(self, node: str) -> Credentials:
        """Read the credentials of a sensor node; raises `CredentialsError`."""
        folder = self.node_credentials_dir
        return NOBODY if folder is None else Credentials.read(folder / f"{node}.toml")
