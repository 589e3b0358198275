"""The fognav command."""

from importlib.metadata import version

__version__ = version("fognav-cli")
