"""The firmware's header: topics, field names, values and limits of all channels of a sensor node.

Preprocessor directives only: usable from C, C++17 and the Arduino core, without memory for what is unused.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from msgspec import inspect

from fog_contracts.channels import BROKER_NAME, CHANNELS, ID_MAX, NODE, Channel
from fog_contracts.generate import NOTE, Field, bounds, message_fields, summary

if TYPE_CHECKING:
    from fog_contracts.messages import Message

_INT_MAX: Final = 2**15
_LONG_MAX: Final = 2**31
"""From these on a number needs a suffix: a board's int may have 16 bits, its long 32."""

_HEAD: Final = f"""\
/* What a sensor node publishes and subscribes to over MQTT.
 * {NOTE}
 *
 * FOGNAV_X_TOPIC is a format for snprintf; the comment behind it names its ids. FOGNAV_X_TOPIC_SIZE is the size of its
 * longest topic with the terminating zero, FOGNAV_X_LIMIT the largest payload of channel X, both in bytes. Field names
 * and values are text. Where _MIN_EXCLUSIVE is defined, _MIN itself is not allowed.
 */
#ifndef FOGNAV_CONTRACT_H
#define FOGNAV_CONTRACT_H

"""


def firmware_header() -> str:
    """Return the header's text."""
    blocks = [
        _define("FOGNAV_ID_MAX", str(ID_MAX), "characters of the longest id: a-z, 0-9, and - except at the start"),
        _define("FOGNAV_BROKER_NAME", f'"{BROKER_NAME}"', "in the broker's certificate, whatever its address"),
    ]
    blocks += [_channel(row) for row in CHANNELS.values() if NODE in (*row.publishers, *row.subscribers)]
    return _HEAD + "\n".join(blocks) + "\n#endif /* FOGNAV_CONTRACT_H */\n"


def _channel(row: Channel) -> str:
    name = _macro(row.name)
    direction = "published" if NODE in row.publishers else "subscribed"
    size = len(re.sub(r"\{\w+\}", "", row.template)) + ID_MAX * len(row.fields) + 1
    about = summary(row.message) if row.message else row.about
    lines = [
        f"/* {row.name}, {direction} by a node: {about} */\n",
        _define(f"{name}_TOPIC", _text(re.sub(r"\{\w+\}", "%s", row.template)), ", ".join(row.fields)),
        _define(f"{name}_TOPIC_SIZE", str(size)),
        _define(f"{name}_LIMIT", str(row.limit), "bytes"),
        _define(f"{name}_QOS", str(row.qos)),
        _define(f"{name}_RETAINED", str(int(row.retained))),
    ]
    if row.rate_hz is not None:
        lines.append(_define(f"{name}_PERIOD_MS", str(round(row.period_s * 1000))))
    if math.isfinite(row.max_age_s):
        lines.append(_define(f"{name}_MAX_AGE_MS", str(round(row.max_age_s * 1000)), "older is stale"))
    lines += [_define(f"{name}_{_upper(value)}", _text(value)) for value in row.values]
    if row.message is not None:
        lines += _message(name, row.message)
    return "".join(lines)


def _message(name: str, kind: type[Message]) -> list[str]:
    lines: list[str] = []
    for each in message_fields(kind):
        macro = f"{name}_{_upper(each.name)}"
        unit = each.unit or ""
        comment = ", ".join(part for part in (unit, "may be null" if each.nullable else "") if part)
        lines.append(_define(f"{macro}_FIELD", _text(each.name), comment))
        lines += _lengths(macro, each)
        low_sign, low, high_sign, high = bounds(each.element)
        if low is not None:
            lines.append(_define(f"{macro}_MIN", _number(low)))
            lines += [_define(f"{macro}_MIN_EXCLUSIVE", "1")] if low_sign == ">" else []
        if high is not None:
            lines.append(_define(f"{macro}_MAX", _number(high)))
            lines += [_define(f"{macro}_MAX_EXCLUSIVE", "1")] if high_sign == "<" else []
        if isinstance(each.default, int | float) and not isinstance(each.default, bool):
            lines.append(_define(f"{macro}_DEFAULT", _number(each.default)))
        lines += [_define(f"{macro}_{_upper(value)}", _text(value)) for value in each.choices]
    return lines


def _lengths(macro: str, each: Field) -> list[str]:
    lines: list[str] = []
    for kind in (each.type, each.element):
        if isinstance(kind, inspect.ListType | inspect.StrType):
            noun = "ITEMS" if isinstance(kind, inspect.ListType) else "LENGTH"
            if kind.min_length is not None:
                lines.append(_define(f"{macro}_{noun}_MIN", str(kind.min_length)))
            if kind.max_length is not None:
                lines.append(_define(f"{macro}_{noun}_MAX", str(kind.max_length)))
        if each.type is each.element:
            break
    return lines


def _define(name: str, value: str, comment: str = "") -> str:
    return f"#define {name} {value}" + (f" /* {comment} */" if comment else "") + "\n"


def _macro(name: str) -> str:
    return f"FOGNAV_{_upper(name)}"


def _upper(name: str) -> str:
    return re.sub(r"\W", "_", name).upper()


def _text(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _number(value: float) -> str:
    text = repr(value)
    if isinstance(value, int) and abs(value) >= _INT_MAX:
        text += "L" if abs(value) < _LONG_MAX else "LL"
    return f"({text})" if value < 0 else text
