"""What other systems report: their robots where they are, and obstacles, each lethal until its report expires.

A robot that drives is drawn anew only once it has moved by `MOVED_M`: each change is a version of the map, and may be
a search for new paths. Fognav's own robots are on no map (`obstacles`), and see each other by their lidars: each of
them would stand in a blocked place. Robots of others follow masks that leave robots out.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.geometry import GeometryError
from fog_contracts.handlers import RefusedMessageError
from fog_contracts.messages import Cause, CircleShape
from fog_contracts.shapes import ShapeMask, shape_spans
from map_service.layers.base import CostLayer, LayerFactory, NoOptions, write_cost

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Final

    from fog_contracts.channels import Channel
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import Reported, Shape
    from map_service.layers.base import Grid

MOVED_M: Final = 0.1
"""A circle that has moved less (m) stays where it is drawn."""
MAX_THINGS: Final = 200
MAX_SIDE_M: Final = 20.0
"""Nothing that is wider or higher is an obstacle: a whole floor is closed by a zone, which an operator draws."""


class _Thing(NamedTuple):
    shape: Shape
    mask: ShapeMask
    expiry: float
    """When it vanishes (s, monotonic)."""


class ReportedLayer(CostLayer):
    """Holds what is reported, by its id."""

    def __init__(self, geometry: GridGeometry) -> None:
        super().__init__()
        self._geometry = geometry
        self._things: dict[str, _Thing] = {}

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handler of reports."""
        return {ch.REPORTED: self._on_reported}

    def _on_reported(self, ids: Ids, told: Reported, at: Moment) -> list[Publication]:
        name, known = ids["thing"], self._things.get(ids["thing"])
        if told.shape is None:
            self._remove(name)
            return []
        expiry = at.now + told.ttl
        if known is not None and _is_near(known.shape, told.shape):
            self._things[name] = known._replace(expiry=expiry)
            return []
        if known is None and len(self._things) >= MAX_THINGS:
            self.refused += 1
            return []
        try:
            mask = self._mask(told.shape)
        except GeometryError as error:
            raise RefusedMessageError(f"what is reported as {name}: {error}") from error
        self._remove(name)
        self._things[name] = _Thing(told.shape, mask, expiry)
        self.mark_updated(mask.window, Cause(kind="obstacle", id=name, state="reported"))
        return []

    def _mask(self, shape: Shape) -> ShapeMask:
        spans = shape_spans(shape, self._geometry)
        if max(spans.window.width, spans.window.height) * self._geometry.resolution > MAX_SIDE_M:
            raise GeometryError(f"it is wider or higher than {MAX_SIDE_M:g} m: let an operator draw a zone instead")
        return spans.to_mask()

    def tick(self, at: Moment) -> list[Publication]:
        """Remove what nobody has reported again."""
        for name in [name for name, thing in self._things.items() if thing.expiry <= at.now]:
            self._remove(name)
        return []

    def _remove(self, name: str) -> None:
        if (thing := self._things.pop(name, None)) is not None:
            self.mark_updated(thing.mask.window, Cause(kind="obstacle", id=name, state="gone"))

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:  # noqa: ARG002  # they limit no speed
        """Write what is reported."""
        for thing in self._things.values():
            write_cost(thing.mask, window, cost, LETHAL)


def _is_near(old: Shape, new: Shape) -> bool:
    """Whether a shape need not be drawn anew."""
    if isinstance(old, CircleShape) and isinstance(new, CircleShape):
        return old.radius == new.radius and math.dist(old.centre, new.centre) < MOVED_M
    return old == new


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: ReportedLayer(plan.geometry))
