"""One OpenAPI document of all services, as they are reached under one address."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

OpenApi = dict[str, Any]
_REFERENCE: Final = "#/components/schemas/"


def merged(services: Mapping[str, Mapping[str, Any]], title: str = "Fognav") -> OpenApi:
    """Return one document of several services' documents, which are given by the services' names.

    What several of them have, such as `/readyz`, is at `/SERVICE/readyz`, as the gateway has it. Schemas of one name
    that differ, or refer to some that differ, get the service's name before theirs. An identifier of a problem says
    what each of them says. The same documents give the same one, whatever their order. Raises `ValueError` if two
    services use an identifier with different statuses.
    """
    names = {service: _schema_names(service, services) for service in services}
    routes = [path for described in services.values() for path in described["paths"]]
    paths: OpenApi = {}
    components: OpenApi = {"schemas": {}}
    problems: dict[str, OpenApi] = {}
    for service in sorted(services):
        own = _renamed(dict(services[service]), names[service])
        for path, operations in own["paths"].items():
            if routes.count(path) == 1:
                paths[path] = operations
                continue
            prefix = service.replace("-", "_")
            paths[f"/{service}{path}"] = {
                method: {**operation, "operationId": f"{prefix}_{operation['operationId']}"}
                for method, operation in operations.items()
            }
        for kind, members in own.get("components", {}).items():
            for name, member in members.items():
                known = names[service][name] if kind == "schemas" else name
                components.setdefault(kind, {})[known] = member
        for code, problem in own.get("x-problems", {}).items():
            _add_problem(problems, code, problem)
    first = services[min(services)]
    document = {"openapi": first["openapi"], "info": {**first["info"], "title": title}}
    document |= {"paths": paths, "components": components, "x-problems": problems}
    return json.loads(json.dumps(document, sort_keys=True))  # type: ignore[no-any-return]  # an object, as it was


def _schema_names(service: str, services: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return what each schema of a service is called among those of all services."""
    own = services[service]["components"]["schemas"]
    others = [other["components"]["schemas"] for name, other in services.items() if name != service]
    prefix = "".join(part.capitalize() for part in service.split("-"))
    return {
        name: f"{prefix}{name}"
        if any(name in other and _whole(name, other) != _whole(name, own) for other in others)
        else name
        for name in own
    }


def _whole(name: str, schemas: Mapping[str, Any]) -> dict[str, Any]:
    """Return a schema with all that it refers to, at whatever remove."""
    found: dict[str, Any] = {}
    open_names = [name]
    while open_names:
        current = open_names.pop()
        if current not in found:
            found[current] = schemas[current]
            open_names += _references(schemas[current])
    return found


def _references(part: object) -> Iterator[str]:
    if isinstance(part, dict):
        for key, value in part.items():
            if key == "$ref":
                yield value.removeprefix(_REFERENCE)
            else:
                yield from _references(value)
    elif isinstance(part, list):
        for value in part:
            yield from _references(value)


def _renamed(part: Any, names: Mapping[str, str]) -> Any:  # noqa: ANN401  # any part of a JSON document
    """Return a part of a document in which references name schemas as `names` says."""
    if isinstance(part, list):
        return [_renamed(value, names) for value in part]
    if not isinstance(part, dict):
        return part
    if "$ref" in part:
        return {**part, "$ref": _reference(part["$ref"], names)}
    renamed = {key: _renamed(value, names) for key, value in part.items()}
    if mapping := part.get("discriminator", {}).get("mapping"):
        renamed["discriminator"]["mapping"] = {key: _reference(value, names) for key, value in mapping.items()}
    return renamed


def _reference(reference: str, names: Mapping[str, str]) -> str:
    return _REFERENCE + names[reference.removeprefix(_REFERENCE)]


def _add_problem(problems: dict[str, OpenApi], code: str, problem: OpenApi) -> None:
    known = problems.setdefault(code, dict(problem))
    if known["status"] != problem["status"]:
        raise ValueError(
            f"two services have the problem {code}, with the statuses {known['status']} and {problem['status']}: "
            "give one of them another identifier"
        )
    for part in ("says", "remedy"):
        if problem[part] not in known[part].split("; or: "):
            known[part] += f"; or: {problem[part]}"
