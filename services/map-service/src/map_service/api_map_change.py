"""REST for another map: uploaded, looked at before it is in force, put into force, and back (ADR 66)."""

import asyncio
import contextlib
import hashlib
import os
import re
import sys
from pathlib import Path
from typing import Annotated, Final

import msgspec
from fastapi import Response

from fog_contracts import channels as ch
from fog_contracts.messages import Count, DryRunReply, DryRunRequest, Message, PointXY
from fog_mapping.another_map import Finding
from fog_runtime.concurrency import BusyError
from fog_runtime.configuration.uploaded_maps import MapName
from fog_runtime.http import MAP_UPLOAD, Admin, Answer, Body, ProblemError, Routes, Viewer, etag
from fog_runtime.http.store_routes import IdempotencyKey, UndoBody, Undone, add_undo_errors, attempt_of, undone
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt
from fog_runtime.stores.undo import UndoError, values
from map_service.map_check import MapReport, MapUpload, Outcome, Task, picture_file
from map_service.problems import ZONES_NOT_LOADED, MapProblem, require_zones
from map_service.record_requests import WRITES
from map_service.record_writer import ConflictError
from map_service.service import Service
from map_service.site_map import MAP_ID, StoredMap
from map_service.undo import bring_back

LEAST_AGREEMENT: Final = 0.7
_CHECK_S: Final = 24.0
_ROBOTS_S: Final = 4.0
"""Both together: a gateway waits for an answer for 30 s."""
_NAMED: Final = 5
_KINDS: Final = (b"\x89PNG", b"P2", b"P5")
_KEPT: Final = 4
"""Uploads that are kept beside the maps that are, or were, in force."""


class MapPreviewBody(Message, frozen=True, kw_only=True):
    """Which map to look at: an upload, or with `back` the one before the map in force."""

    upload: MapUpload | None = None
    back: bool = False


class MapPreview(MapReport, frozen=True, kw_only=True):
    """What a map would change. `id` names this answer: apply the map by it.

    `accepted`: it may be applied as it is; `refused`: not at all, because no service would start with what its findings
    say. Robots' poses and goals are looked up only if `robots` says that the planner told them.
    """

    id: str
    accepted: bool
    refused: bool
    robots: bool


_ID: Final = r"^([0-9a-f]{16}|site)-([0-9]{1,9})-[0-9a-f]{12}$(?!\n)"
"""The map, the version of the record that its preview was made for, and what was seen."""
PreviewId = Annotated[str, msgspec.Meta(pattern=_ID)]


class MapChangeBody(Message, frozen=True, kw_only=True):
    """Which preview to apply; `accept`: although something would lie in a wall, or hardly a wall agrees."""

    preview: PreviewId
    accept: bool = False


class MapState(Message, frozen=True, kw_only=True):
    """The map in force: `name` is its fingerprint, null for that of `site.toml`; `version` counts the changes by REST.

    `back`: there is one before it.
    """

    name: MapName | None
    version: Count
    back: bool


class _Checks:
    """Looks at maps, one at a time, each in a process of its own."""

    def __init__(self, service: Service, site_dir: Path) -> None:
        self._service, self._site_dir = service, site_dir
        self.maps = service.maps
        self.applying = asyncio.Lock()
        self._looking = False

    @property
    def stored(self) -> StoredMap | None:
        return self._service.site_map.records.get(MAP_ID)

    @property
    def version(self) -> int:
        return 0 if self.stored is None else self.stored.version

    async def look(self, *, upload: MapUpload | None = None, name: MapName | None = None) -> MapPreview:
        """Return what a map would change; raises `BusyError`, and `ProblemError` for what is no map."""
        if self._looking:
            raise BusyError("another map is being looked at")
        if name is not None and not self.maps.file(name).is_file():
            detail = f"{self.maps.file(name)} is gone: upload that map again"
            raise ProblemError(MapProblem.MAP_INVALID, detail, field="body")
        self._looking = True
        try:
            return await self._looked(upload, name)
        finally:
            self._looking = False

    async def apply(self, change: MapChangeBody, who: str, attempt: Attempt | None) -> StoredMap:
        """Put a map into force; raises `ProblemError` if it does not do what was seen, and as `look` and a write."""
        name, version = _parts(change.preview)
        if version != self.version:
            raise ConflictError("stale", MAP_ID, self._service.site_map.table.name)
        if name is not None and not self.maps.file(name).is_file():
            raise _no_preview(change.preview)
        preview = await self.look(name=name)
        if preview.id != change.preview:
            detail = f"this is not what you have seen: {_told(preview.findings)}. Look at the preview again"
            raise ProblemError(MapProblem.MAP_NOT_SEEN, detail)
        if preview.refused or not (preview.accepted or change.accept):
            raise ProblemError(MapProblem.MAP_DOES_NOT_FIT, _why(preview))
        before = None if self.stored is None else self.stored.name
        record = StoredMap(id=MAP_ID, name=preview.name, over=preview.over, previous=before)
        return await self._service.site_map.put(record, version, who, attempt, action="replace")

    async def _looked(self, upload: MapUpload | None, name: MapName | None) -> MapPreview:
        core, robots = self._service.core, await self._robots()
        task = Task(
            root=str(self.maps.folder.parent),
            site_dir=str(self._site_dir),
            site=self.maps.folder.name,
            upload=upload,
            name=name,
            zones=core.zones.zones(),
            places=dict(core.places),
            poses={} if robots is None else robots[0],
            goals={} if robots is None else robots[1],
        )
        outcome = await _run(msgspec.msgpack.encode(task))
        if outcome.bad is not None:
            field = f"body.upload.{outcome.bad.field}"
            raise ProblemError(MapProblem.MAP_INVALID, outcome.bad.problem, field=field)
        assert outcome.report is not None
        report = outcome.report
        await asyncio.to_thread(self._forget_old, report.name)
        refused = bool(report.trouble) or any(one.refused for one in report.findings)
        seen = [(one.kind, one.id, one.code) for one in report.findings]
        same = repr((report.agreement >= LEAST_AGREEMENT, seen)).encode()
        return MapPreview(
            **{name: getattr(report, name) for name in MapReport.__struct_fields__},
            id=f"{report.name or 'site'}-{self.version}-{hashlib.sha256(same).hexdigest()[:12]}",
            accepted=not refused and not report.findings and report.agreement >= LEAST_AGREEMENT,
            refused=refused,
            robots=robots is not None,
        )

    async def _robots(self) -> tuple[dict[str, PointXY], dict[str, PointXY]] | None:
        """Return where the robots stand and where they are sent; None if the planner does not tell."""
        reply = await self._service.zenoh.query(ch.PLANNER_DRY_RUN, DryRunRequest(), DryRunReply, _ROBOTS_S)
        if reply is None or reply.outcome is None:
            return None
        robots = reply.outcome.robots
        poses = {each.robot: each.at for each in robots if each.at is not None}
        return poses, {each.robot: each.goal for each in robots if each.goal is not None}

    def _forget_old(self, new: MapName | None) -> None:
        """Delete the oldest uploads that nobody has applied."""
        if new is not None:  # it is the newest now, even if it was uploaded long ago: it may be put into force next
            os.utime(self.maps.file(new))
        kept = {new, *(() if self.stored is None else (self.stored.name, self.stored.previous))}
        files = sorted(self.maps.folder.glob("*.yaml"), key=lambda file: file.stat().st_mtime, reverse=True)
        for file in [file for file in files if file.stem not in kept][_KEPT:]:
            for each in (file, file.with_suffix(".png"), picture_file(self.maps, file.stem)):
                each.unlink(missing_ok=True)


async def _run(task: bytes) -> Outcome:
    """Run the check in a process of its own."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("FOGNAV_")}
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "map_service.map_check",
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, env=environment,
    )  # fmt: skip
    try:
        async with asyncio.timeout(_CHECK_S):
            told, trouble = await process.communicate(task)
    except TimeoutError:
        detail = f"it took more than {_CHECK_S:.0f} s: use a coarser resolution, or cut off what is not the floor"
        raise ProblemError(MapProblem.MAP_INVALID, detail, field="body.upload.image") from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
    if process.returncode:
        last = trouble.decode("utf-8", "replace").strip().rpartition("\n")[2]
        detail = f"it could not be looked at ({last or 'this machine has too little memory'}): use a coarser resolution"
        raise ProblemError(MapProblem.MAP_INVALID, detail, field="body.upload.image")
    return msgspec.json.decode(told.strip().rpartition(b"\n")[2], type=Outcome)


def add_map_change(routes: Routes, service: Service, site_dir: Path) -> None:  # noqa: C901  # routes beside each other
    """Add the routes; `routes` knows the errors of the service and of the store."""
    checks, maps = _Checks(service, site_dir), service.maps
    add_undo_errors(routes)

    @routes.get("/api/v1/map/state", problems=ZONES_NOT_LOADED)
    async def map_state(_caller: Viewer) -> Answer[MapState]:
        """Return which map is in force, and whether there is one before it."""
        require_zones(service)
        stored = checks.stored
        # Who lets site.toml name another map later means that one.
        name = None if stored is None or stored.over != maps.site_map else stored.name
        return Answer(MapState(name=name, version=checks.version, back=stored is not None), etag(checks.version))

    @routes.post(
        MAP_UPLOAD, raises=[BusyError], problems=[MapProblem.MAP_INVALID, MapProblem.NO_MAP_BEFORE, *ZONES_NOT_LOADED]
    )
    async def preview_map(body: Body[MapPreviewBody], _caller: Admin) -> MapPreview:
        """Look at a map: what would lie in a wall or off it, what changes; changes nothing. At most 8 MiB of JSON.

        It is taken as it lies: in the frame of the present map. `fognav map change` lays one of another frame onto it.
        """
        require_zones(service)
        if body.back:
            stored = checks.stored
            if stored is None:
                raise ProblemError(
                    MapProblem.NO_MAP_BEFORE, "the map in force is that of site.toml: there is none before"
                )
            return await checks.look(name=stored.previous)
        if body.upload is None:
            detail = "send `upload` with the map, or `back`"
            raise ProblemError(MapProblem.MAP_INVALID, detail, field="body.upload")
        if not body.upload.image.startswith(_KINDS):  # what is no picture at all needs no process of its own
            detail = "the picture is no PGM or PNG: save it as one"
            raise ProblemError(MapProblem.MAP_INVALID, detail, field="body.upload.image")
        return await checks.look(upload=body.upload)

    @routes.get("/api/v1/map/previews/{preview}.png", media_type="image/png", problems=[MapProblem.NO_MAP_PREVIEW])
    async def preview_picture(preview: str, _caller: Admin) -> Response:
        """Return the plan of a map that was looked at: red are walls that come, blue those that go."""
        try:
            data = await asyncio.to_thread(picture_file(maps, _parts(preview)[0]).read_bytes)
        except FileNotFoundError:
            raise _no_preview(preview) from None
        return Response(data, media_type="image/png", headers={"Cache-Control": "no-store"})

    @routes.put(
        "/api/v1/map",
        raises=[*WRITES, BusyError],
        problems=[
            MapProblem.NO_MAP_PREVIEW, MapProblem.MAP_CHANGED, MapProblem.MAP_NOT_SEEN, MapProblem.MAP_DOES_NOT_FIT,
            MapProblem.MAP_INVALID, *ZONES_NOT_LOADED,
        ],
    )  # fmt: skip
    async def put_map(
        body: Body[MapChangeBody], caller: Admin, idempotency_key: IdempotencyKey = None
    ) -> Answer[MapState]:
        """Put a map into force that was looked at, if it would do the same now. The services start anew with it.

        Robots stop, lose their missions, and look for themselves on the new map; an operator enables them then.
        """
        require_zones(service)
        attempt = attempt_of(idempotency_key, caller, "PUT /api/v1/map", body)
        if (earlier := await service.site_map.earlier_result(attempt)) is not None:
            return _answer(earlier)
        async with checks.applying:
            return _answer(await checks.apply(body, caller.name, attempt))

    @routes.post(
        "/api/v1/map/undo",
        raises=[UndoError, ConflictError, StoreError, BusyError],
        problems=[MapProblem.MAP_DOES_NOT_FIT, MapProblem.MAP_CHANGED, MapProblem.MAP_INVALID, *ZONES_NOT_LOADED],
    )
    async def undo_map(body: Body[UndoBody], caller: Admin) -> Undone:
        """Undo the latest change of the map: the one before comes back, if services can start with it."""
        require_zones(service)
        async with checks.applying:
            before, after = values(await service.undoable(body.entry, MAP_ID, ("map",)), StoredMap)
            preview = await checks.look(name=None if before is None else before.name)
            if preview.refused:
                raise ProblemError(MapProblem.MAP_DOES_NOT_FIT, _why(preview))
            return undone("map", MAP_ID, await bring_back(service.site_map, before, after, caller.name))


def _parts(preview: str) -> tuple[MapName | None, int]:
    """Return which map a preview is of, and for which version; raises `ProblemError`."""
    found = re.fullmatch(_ID, preview)
    if found is None:
        raise _no_preview(preview)
    return None if found[1] == "site" else found[1], int(found[2])


def _no_preview(preview: str) -> ProblemError:
    return ProblemError(
        MapProblem.NO_MAP_PREVIEW, f"there is no preview {preview[:40]!r} any more: upload the map again"
    )


def _answer(record: StoredMap) -> Answer[MapState]:
    return Answer(MapState(name=record.name, version=record.version, back=True), etag(record.version))


def _told(found: list[Finding]) -> str:
    return "; ".join(map(str, found[:_NAMED])) or "nothing lies in a wall"


def _why(preview: MapPreview) -> str:
    if preview.refused:
        fixed = [one for one in preview.findings if one.refused]
        trouble = _told(fixed) if fixed else preview.trouble
        return f"the services would not start: {trouble}. Move that in site.toml to where both maps allow it"
    if preview.findings:
        return f"{_told(preview.findings)}. Move what was named, or send `accept`"
    share = f"only {preview.agreement:.0%} of the walls of both maps lie on each other"
    return f"{share}: it is of another floor, or has another frame (fognav map change lays it onto this one)"
