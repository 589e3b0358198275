"""Which servers of a demonstration are Python packages, because they are not installed and can't be."""

from collections.abc import Callable
from typing import Final

from fog_supervisor import servers
from fognav import programs, system

_TOOLS: Final = {programs.BROKER: system.MOSQUITTO, programs.REDIS: system.REDIS}


def embedded_servers(*, forced: bool, yes: bool, print_line: Callable[[str], None]) -> frozenset[str]:
    """Return which servers run as Python packages, after an attempt to install what is missing, and say what they lack.

    All of them when `forced`. Raises `MissingToolsError` if no package stands in for a missing one.
    """
    missing = list(_TOOLS)
    if not forced:
        try:
            system.ensure(list(_TOOLS.values()), yes=yes, print_line=print_line)
        except system.MissingToolsError as error:
            missing = [name for name, tool in _TOOLS.items() if system.find(tool) is None]
            if not all(servers.has_stand_in(name) for name in missing):
                raise
            print_line(str(error))
        else:
            return frozenset()
    print_line("this demo runs without them, on Python packages. They are for trying Fognav only:")
    for name in missing:
        package, limits = servers.STAND_INS[name]
        print_line(f"  {package} instead of {_TOOLS[name].name}: {limits}")
    return frozenset(missing)
