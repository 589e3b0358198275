"""The settings of the planner (environment FOGNAV_*), on top of those of every process."""

from pathlib import Path

from fog_runtime.access.operator_key import OperatorKeyError, read_operator_key
from fog_runtime.configuration.settings import InflationSettings, SettingsError


class Settings(InflationSettings, frozen=True, kw_only=True):
    """The inflation should equal the map-service's: a different one only makes the search slower.

    `release_m` is the released length: how far (m) a robot may drive without a message from the planner.
    """

    release_m: float = 15.0


def read_key(file: Path | None) -> bytes | None:
    """Return the key that signs commands to robots, None without a file; raises `SettingsError` for an unusable one.

    Without it the planner can stop robots, but not enable them.
    """
    if file is None:
        return None
    try:
        return read_operator_key(file)
    except OperatorKeyError as error:
        raise SettingsError(str(error)) from error
