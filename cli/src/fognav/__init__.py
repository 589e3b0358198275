"""The fognav command."""

from fog_runtime.version import VERSION

__version__ = VERSION
