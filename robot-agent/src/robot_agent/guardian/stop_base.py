"""`python -m robot_agent.guardian.stop_base`: stop the wheels once, for whoever has seen the watchdog end.

A service manager runs it after the watchdog, however that ended. Settings: the watchdog's.
"""

from __future__ import annotations

import sys

from robot_agent.guardian.watchdog import BadSettings, let_charge, log_event, read_settings, stop_wheels
from robot_agent.serial_port import PortLost, PortNameError, open_port


def main() -> int:
    """Write the stop command to the base; return 0 if it was written, 1 if the port can't be used."""
    try:
        settings = read_settings()
        with open_port(settings.path, settings.base.baud) as port:
            stopped = stop_wheels(port, settings.base.stop)
            let_charge(port, settings.base)
    except (BadSettings, PortNameError, PortLost) as error:
        log_event("stop_failed", reason=str(error))
        return 1
    log_event("base_stopped", written=stopped)
    return 0 if stopped else 1


if __name__ == "__main__":
    sys.exit(main())
