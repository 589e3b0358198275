"""`fognav status`: the systems that run on this machine, or one fog node elsewhere."""

import asyncio
import datetime as dt
import os
from pathlib import Path
from typing import Final

import msgspec

from fog_runtime import logs
from fog_runtime.clock import SystemClock
from fog_runtime.credentials import Credentials
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav.credentials import open_security, own_credentials, security_errors
from fognav.hosting.folders import SECURITY
from fognav.operate.fog import FOG, Fog, find_fog
from fognav.operate.options import FogOption, JsonOption
from fognav.operate.systems import SERVICE_PORTS, System, find_systems
from fognav.output import FailedError, WrongUseError, exit_codes, fail, print_answer, print_json, print_line
from fognav.programs import ROUTER


def status_command(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """Show the systems that run on this machine.

    These are demos, a fog node and robots, each with what is connected to its router from anywhere. With --fog or
    FOGNAV_FOG, show that fog node instead. The exit code is 1 if nothing runs.
    """
    with exit_codes():
        systems = [_remote(find_fog(fog))] if fog or os.environ.get(FOG) else find_systems()
        shown = [
            (system, connected(system, own_credentials(system.credentials_file)), certificates_end(system))
            for system in systems
        ]
    if json:
        print_json(
            {
                "systems": [
                    {**msgspec.to_builtins(system), "connected": names, "certificates_end": ends and ends.isoformat()}
                    for system, names, ends in shown
                ]
            }
        )
    else:
        for system, names, ends in shown:
            _show(system, names, ends)
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


def certificates_end(system: System) -> dt.datetime | None:
    """Return when the first certificate of a fog node's servers, or their authority, ends; None for other systems.

    None, too, for credentials that can't be read, which a warning names: what runs is shown all the same.
    """
    if system.data is None:
        return None
    try:
        with security_errors():
            return min(open_security(Path(system.data) / SECURITY).expiries().values())
    except (FailedError, WrongUseError) as error:
        print_line(f"certificates of {system.name}: {error}")
        return None


def _show(system: System, present: list[str] | None, ends: dt.datetime | None) -> None:
    print_answer(f"{system.name}: {system.kind}" + (f", site {system.site}" if system.site else ""))
    for name, url in system.urls.items():
        print_answer(f"  {name:18} {url}")
    if system.token_file:
        print_answer(f"  {'token':18} {system.token_file}")
    if ROUTER in system.urls:
        shown = "not visible" if present is None else ", ".join(present) or "nothing"
        print_answer(f"  {'connected':18} {shown}")
    if ends is not None:
        soon = ends - dt.datetime.now(dt.UTC) < _SOON
        print_answer(f"  {'certificates':18} valid until {ends:%Y-%m-%d}" + (": see fognav doctor" if soon else ""))
    print_answer(
        f"  {'processes':18} {', '.join(f'{name} {pid}' for name, pid in system.pids.items()) or 'not visible'}"
    )


_CONSOLE: Final = "status"
_SOON: Final = dt.timedelta(days=60)
"""As the alert CertificateEnds."""


def connected(system: System, credentials: Credentials) -> list[str] | None:
    """Return the connected processes as `role/id`, sorted; None if the system has no router that can be reached.

    They say so themselves for as long as their sessions are open (channel `live`): no safety signal, and a process that
    hangs is still listed.
    """
    if ROUTER not in system.urls or not system.site:
        return None
    if system.urls[ROUTER].startswith("tls/") and "zenoh" not in credentials.passwords:
        return None  # a person's token is for REST: the router admits programs
    logs.configure("fognav", "error", "text")
    return asyncio.run(_connected(system.urls[ROUTER], system.site, credentials))


async def _connected(endpoint: str, site: str, credentials: Credentials) -> list[str] | None:
    opened = ZenohEdge.open(
        connect=[endpoint], clock=SystemClock(), role="console", id=_CONSOLE, site=site, credentials=credentials
    )
    async with opened as edge:
        if not edge.connected:
            return None
        return sorted(f"{role}/{name}" for role, name in await edge.present())
