"""`fognav status`: the systems that run on this machine, or one fog node elsewhere."""

import os

import msgspec

from fognav.locking import own_credentials
from fognav.operate.fog import FOG, Fog, find_fog
from fognav.operate.options import FogOption, JsonOption
from fognav.operate.presence import connected
from fognav.operate.registry import System
from fognav.operate.systems import SERVICE_PORTS, find_systems
from fognav.output import FailedError, exit_codes, fail, print_answer, print_json


def status_command(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """Show the systems that run on this machine.

    These are demos, a fog node and robots, each with what is connected to its router from anywhere. With --fog or
    FOGNAV_FOG, show that fog node instead. The exit code is 1 if nothing runs.
    """
    with exit_codes():
        systems = [_remote(find_fog(fog))] if fog or os.environ.get(FOG) else find_systems()
        present = [connected(system, own_credentials(system.credentials_file)) for system in systems]
    if json:
        shown = zip(systems, present, strict=True)
        print_json({"systems": [{**msgspec.to_builtins(system), "connected": names} for system, names in shown]})
    else:
        for system, names in zip(systems, present, strict=True):
            _show(system, names)
    if not systems:
        fail("nothing runs on this machine. Start a demo: fognav demo --keep-running")


def _remote(fog: Fog) -> System:
    """Return a fog node with the services that answer; raises `FailedError` if none does."""
    problems = []
    urls = dict(fog.system.urls)
    for service in SERVICE_PORTS:
        try:
            fog.get(service, "/healthz")
        except FailedError as error:
            problems.append(str(error))
            urls.pop(service, None)
    if len(problems) == len(SERVICE_PORTS):
        raise FailedError(problems[0])
    return msgspec.structs.replace(fog.system, site=fog.site, urls=urls)


def _show(system: System, present: list[str] | None) -> None:
    print_answer(f"{system.name}: {system.kind}" + (f", site {system.site}" if system.site else ""))
    for name, url in system.urls.items():
        print_answer(f"  {name:18} {url}")
    if system.token_file:
        print_answer(f"  {'token':18} {system.token_file}")
    if present is not None:
        print_answer(f"  {'connected':18} {', '.join(present) or 'nothing'}")
    print_answer(
        f"  {'processes':18} {', '.join(f'{name} {pid}' for name, pid in system.pids.items()) or 'not visible'}"
    )
