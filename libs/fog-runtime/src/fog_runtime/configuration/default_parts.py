"""The names of the base and the lidar of a robot whose settings name none: the hardware of the thesis.

The one place outside their own folders that names them. Imports only the standard library, because the watchdog uses
it.
"""

from typing import Final

DEFAULT_BASE: Final = "roomba600"
"""In the entry points `fognav.bases`, `fognav.base_stops` and `fognav.base_emulators`."""
DEFAULT_LIDAR: Final = "rplidar-a1"
"""In the entry points `fognav.lidars` and `fognav.lidar_emulators`."""
