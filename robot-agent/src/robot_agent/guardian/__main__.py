"""`python -m robot_agent.guardian`: one guardian, for the watchdog that started it."""

import sys

from robot_agent.guardian.process import main

if __name__ == "__main__":
    sys.exit(main())
