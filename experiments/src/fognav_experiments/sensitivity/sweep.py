"""Drives a sweep: on every core of this machine, or on the workers of a Dask cluster; may be killed at any moment.

A digest of the sources that a drive in lockstep runs says whether two machines drive the same.
"""

from __future__ import annotations

import contextlib
import hashlib
import socket
from concurrent.futures import FIRST_COMPLETED, Executor, wait
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Pose
from fognav_experiments import worker_pool
from fognav_experiments.lockstep import release_drives, run_lockstep
from fognav_experiments.rigs import Tuning
from fognav_experiments.sensitivity.planes import SweptDrive, varied_site
from fognav_sim.drive.hazard import HazardRequest

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.records import DriveFiles
    from fognav_experiments.sensitivity.planes import SweepTask

_PACKAGES: Final = (
    "fog_contracts", "fog_kernels", "fog_runtime", "fog_supervisor", "fognav_experiments", "fognav_sim",
    "hazard_aggregator", "map_service", "planner", "robot_agent",
)  # fmt: skip


@cache
def digest() -> str:
    """Return a hash of all modules of Fognav that a drive can import, as they are installed here."""
    found = hashlib.sha256()
    for package in _PACKAGES:
        spec = find_spec(package)
        if spec is None or spec.submodule_search_locations is None:
            raise RuntimeError(f"the package {package} is not installed: install fognav-experiments again")
        for place in map(Path, spec.submodule_search_locations):
            for file in sorted(place.rglob("*.py")):
                found.update(f"{package}/{file.relative_to(place)}".encode() + b"\0" + file.read_bytes() + b"\0")
    return found.hexdigest()[:16]


CONNECT_S: Final = 20.0
"""Timeout of the connection to a cluster's scheduler."""


class ClusterError(RuntimeError):
    """A cluster can't be used; the message says why, and what to do."""


@contextlib.contextmanager
def workers(jobs: int, cluster: str | None) -> Iterator[Executor]:
    """Give what runs drives: processes of this machine, or the workers of the cluster at an address.

    Raises `ClusterError` without Dask, or if nobody answers at the address.
    """
    if cluster is None:
        with worker_pool.open_pool(jobs) as pool:
            yield pool
        return
    if find_spec("distributed") is None:
        raise ClusterError("--cluster needs Dask: install fognav-experiments[cluster]")
    from distributed import Client  # noqa: PLC0415  # optional

    try:
        client = Client(cluster, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise ClusterError(f"no scheduler answers at {cluster}: {error}. Start one by `dask scheduler`") from error
    with client, client.get_executor(retries=1) as pool:
        yield pool


def sweep(
    site: LoadedSite, asked: Sequence[SweepTask], files: DriveFiles[SweptDrive], pool: Executor, commit: str = ""
) -> Iterator[SweptDrive]:
    """Run the drives that have no record yet, and yield each record once it is written; `commit` is only recorded.

    Raises `ClusterError` if a worker runs other sources than this process.
    """
    due, sources = [task for task in asked if not files.has(task.name)], digest()
    waiting = {pool.submit(swept_drive, site, task, commit, sources) for task in due}
    try:
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                drive = future.result()
                files.write(drive)
                yield drive
    finally:
        for future in waiting:
            future.cancel()


def swept_drive(site: LoadedSite, task: SweepTask, commit: str, sources: str) -> SweptDrive:
    """Drive one task in lockstep; the same whenever and wherever it is repeated.

    commit, sources: revision and digest of the sources of who asks. Raises `ClusterError` if this process has others:
    the drive would be recorded for a commit that did not make it.
    """
    if (own := digest()) != sources:
        raise ClusterError(
            f"the worker {socket.gethostname()} runs other sources of Fognav {version('fognav-experiments')} ({own}) "
            f"than this machine ({sources}): install the same on it, and start it again"
        )
    drawn, variation = task.drawn, task.variation
    origin, goal = (site.site.places[name] for name in (drawn.route.start, drawn.route.goal))
    result = run_lockstep(
        site,
        Pose(x=origin.x, y=origin.y, theta=drawn.theta if origin.theta is None else origin.theta),
        goal,
        drawn.seed,
        HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m),
        watched=varied_site(site.site, variation, drawn.seed) if task.setup != "default" else False,
        profile=task.setup,
        tuning=Tuning(pause_ms=variation.pause_ms, speed_m_s=variation.speed_m_s),
    )
    release_drives()
    return SweptDrive(
        variation=variation,
        setup=task.setup,
        run=drawn.run,
        route=drawn.route.name,
        seed=drawn.seed,
        area=drawn.area,
        success=result.success,
        outcome=result.outcome,
        distance_m=result.distance_m,
        time_s=result.time_s,
        commit=commit,
        version=version("fognav-experiments"),
        sources=own,
    )
