"""What all adapters count."""

from __future__ import annotations

from prometheus_client import Counter

ORDERS = Counter("fognav_bridge_orders_total", "Orders of other systems, by what became of them", ["system", "result"])
REFUSED = Counter(
    "fognav_bridge_refused_messages_total", "Messages of other systems that were not understood", ["system", "reason"]
)
