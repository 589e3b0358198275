"""The version of Fognav that runs: all members have the same, from the file VERSION of the checkout."""

from importlib.metadata import version
from typing import Final

VERSION: Final = version("fog-runtime")
