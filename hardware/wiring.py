"""Draws the wiring of a sensor node and of the robot's cut-off as SVG files in `docs/images`.

Run: python hardware/wiring.py [--check]. With --check nothing is written, and the exit code is 1 if a file is out of
date.
"""

import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape

IMAGES: Final = Path(__file__).parents[1] / "docs" / "images"
_COLOURS: Final = {
    "power": "#c0392b", "ground": "#202020", "trigger": "#2471a3", "echo": "#b9770e", "logic": "#1e8449"
}  # fmt: skip
_STUB: Final = 26


@dataclass
class Drawing:
    """An SVG under construction; all lengths in pixels, y downwards."""

    width: int
    height: int
    title: str
    parts: list[str] = field(default_factory=list)

    def box(self, x: float, y: float, width: float, height: float, label: str, fill: str = "#f4f6f7") -> None:
        """Draw a component with its label in bold at its upper side."""
        self.parts.append(
            f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="6" fill="{fill}" stroke="#566573"/>'
        )
        self.text(x + width / 2, y + 18, label, anchor="middle", bold=True)

    def text(self, x: float, y: float, text: str, *, anchor: str = "start", bold: bool = False) -> None:
        """Write a line of text whose base line is at `y`."""
        weight = ' font-weight="bold"' if bold else ""
        self.parts.append(f'<text x="{x}" y="{y}" text-anchor="{anchor}"{weight}>{escape(text)}</text>')

    def wire(self, kind: str, *points: tuple[float, float]) -> None:
        """Draw a wire through points, in the colour of its kind."""
        path = " ".join(f"{x:g},{y:g}" for x, y in points)
        self.parts.append(f'<polyline points="{path}" fill="none" stroke="{_COLOURS[kind]}" stroke-width="2"/>')

    def joint(self, kind: str, x: float, y: float) -> None:
        """Draw the dot that joins wires."""
        self.parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="3.5" fill="{_COLOURS[kind]}"/>')

    def resistor(self, x: float, y: float, label: str, *, upright: bool = False) -> None:
        """Draw a resistor with its middle at a point, and its value beside it."""
        width, height = (12, 36) if upright else (36, 12)
        self.parts.append(
            f'<rect x="{x - width / 2:g}" y="{y - height / 2:g}" width="{width}" height="{height}" fill="#fff" '
            'stroke="#202020"/>'
        )
        if upright:
            self.text(x + 11, y + 4, label)
        else:
            self.text(x, y - 10, label, anchor="middle")

    def pins(self, x: float, ys: Iterable[tuple[float, str]], *, right: bool) -> None:
        """Write pin names inside a component's edge at `x`, on its right side or on its left."""
        for y, name in ys:
            self.parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="3" fill="#fff" stroke="#566573"/>')
            self.text(x - 8 if right else x + 8, y + 4, name, anchor="end" if right else "start")

    def svg(self) -> str:
        """Return the file."""
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" width="{self.width}" '
            f'height="{self.height}" font-family="DejaVu Sans, Verdana, sans-serif" font-size="13" fill="#17202a">'
        )
        background = f'<rect width="{self.width}" height="{self.height}" fill="#ffffff"/>'
        return "\n".join([head, f"<title>{escape(self.title)}</title>", background, *self.parts, "</svg>", ""])


@dataclass(frozen=True)
class Pins:
    """The board's pins of one sonar, by the names on the board."""

    trigger: str
    echo: str


PROFILES: Final = {
    "standard": (Pins(trigger="D5", echo="D1"), Pins(trigger="D6", echo="D2")),
    "thesis": (Pins(trigger="D0", echo="D1"), Pins(trigger="D3", echo="D6")),
}
"""The firmware's profiles of a D1 mini's pins. `standard` leaves alone all pins that matter when the board boots."""


def node(profile: str) -> str:
    """Return the wiring of a node: a D1 mini, two HC-SR04, and a divider in each echo line."""
    drawing = Drawing(840, 500, f"Wiring of a sensor node, pin profile {profile}")
    first, second = PROFILES[profile]
    drawing.box(40, 110, 170, 270, "Wemos D1 mini")
    names = ["5V", "G", first.trigger, first.echo, second.trigger, second.echo]
    at = dict(zip(("5V", "G", "t1", "e1", "t2", "e2"), (150, 185, 230, 265, 310, 345), strict=True))
    drawing.pins(210, zip(at.values(), names, strict=True), right=True)
    drawing.text(56, 345, "micro USB")
    drawing.text(56, 362, "5 V supply")
    _sonar(drawing, 70, "HC-SR04, left", (at["t1"], at["e1"]), 0)
    _sonar(drawing, 290, "HC-SR04, right", (at["t2"], at["e2"]), 1)
    # 5 V on the outermost column, ground beside it.
    drawing.wire("power", (210, at["5V"]), (250, at["5V"]), (250, 40), (560, 40), (560, 110), (620, 110))
    drawing.wire("power", (560, 110), (560, 330), (620, 330))
    drawing.joint("power", 560, 110)
    drawing.wire("ground", (210, at["G"]), (232, at["G"]), (232, 460), (590, 460), (590, 215), (620, 215))
    drawing.wire("ground", (590, 435), (620, 435))
    drawing.joint("ground", 590, 435)
    drawing.joint("ground", 440, 460)
    drawing.text(40, 30, f"Sensor node, pin profile “{profile}”", bold=True)
    drawing.text(
        40,
        484,
        "An echo is 5 V: 1 kΩ in the line and 2 kΩ to ground leave 3.3 V. 100 µF between 5V and G help a weak supply.",
    )
    return drawing.svg()


def _sonar(drawing: Drawing, top: float, label: str, board: tuple[float, float], index: int) -> None:
    """Draw one sonar with its wires from the board's pins at the heights (trigger, echo)."""
    drawing.box(620, top, 180, 170, label)
    rows = dict(zip(("VCC", "TRIG", "ECHO", "GND"), (top + 40, top + 75, top + 110, top + 145), strict=True))
    drawing.pins(620, [(y, name) for name, y in rows.items()], right=False)
    trigger, echo = board
    column = 300 + 24 * index
    drawing.wire("trigger", (210, trigger), (column, trigger), (column, rows["TRIG"]), (620, rows["TRIG"]))
    # The echo: sonar, 1 kOhm, junction, board; from the junction 2 kOhm to ground.
    junction = 440
    drawing.wire("echo", (620, rows["ECHO"]), (junction, rows["ECHO"]), (column + 60, rows["ECHO"]))
    drawing.wire("echo", (column + 60, rows["ECHO"]), (column + 60, echo), (210, echo))
    drawing.resistor(510, rows["ECHO"], "1 kΩ")
    drawing.joint("echo", junction, rows["ECHO"])
    drawing.wire("echo", (junction, rows["ECHO"]), (junction, rows["ECHO"] + 12))
    drawing.resistor(junction, rows["ECHO"] + 30, "2 kΩ", upright=True)
    drawing.wire("ground", (junction, rows["ECHO"] + 48), (junction, rows["ECHO"] + 60), (590, rows["ECHO"] + 60))
    drawing.joint("ground", 590, rows["ECHO"] + 60)
    drawing.wire("ground", (590, rows["ECHO"] + 60), (590, rows["GND"]), (620, rows["GND"]))


def cut_off() -> str:
    """Return the circuit that takes the power from the robot's motors when its computer falls silent."""
    drawing = Drawing(840, 400, "Cut-off of a robot's battery when its computer falls silent")
    drawing.text(40, 30, "Cut-off: no command for half a second, no power", bold=True)
    drawing.box(40, 60, 160, 110, "serial adapter")
    drawing.pins(200, [(105, "TX to the base"), (140, "GND")], right=True)
    drawing.box(300, 60, 190, 190, "½ 74HCT123")
    drawing.pins(300, [(105, "B"), (140, "A, GND"), (215, "CLR, VCC")], right=False)
    drawing.pins(490, [(105, "Q"), (150, "R/C"), (215, "C")], right=True)
    drawing.wire("logic", (200, 105), (300, 105))
    drawing.wire("ground", (200, 140), (300, 140))
    drawing.wire("power", (300, 215), (230, 215))
    drawing.text(224, 219, "5 V", anchor="end")
    drawing.wire("logic", (490, 150), (540, 150), (540, 164))
    drawing.resistor(540, 182, "10 µF", upright=True)
    drawing.wire("logic", (540, 200), (540, 215), (490, 215))
    drawing.wire("power", (540, 150), (700, 150))
    drawing.joint("logic", 540, 150)
    drawing.resistor(630, 150, "100 kΩ")
    drawing.text(706, 154, "5 V")
    drawing.text(610, 195, "0.45 · R · C = 0.45 s,")
    drawing.text(610, 213, "anew at each byte")
    drawing.wire("logic", (490, 105), (600, 105))
    drawing.box(600, 60, 190, 60, "transistor, relay coil")
    drawing.text(695, 102, "with its diode", anchor="middle")
    for x, width, label in ((130, 90, "fuse"), (300, 150, "mushroom switch"), (530, 150, "relay contact")):
        drawing.box(x, 300, width, 50, label)
    drawing.text(605, 338, "normally open", anchor="middle")
    for left, right in ((40, 130), (220, 300), (450, 530), (680, 790)):
        drawing.wire("power", (left, 325), (right, 325))
    drawing.text(40, 314, "battery +")
    drawing.text(690, 314, "base")
    drawing.wire("power", (255, 325), (255, 372))
    drawing.joint("power", 255, 325)
    drawing.text(
        40, 388, "From here, before the switch: the converter to 5 V for the computer, the lidar and this circuit."
    )
    return drawing.svg()


FILES: Final = {"node-wiring.svg": node("standard"), "node-wiring-thesis.svg": node("thesis"), "cut-off.svg": cut_off()}
"""The text of each file, by its name in `docs/images`."""


def main() -> int:
    """Write the files that are out of date, or with --check only name them."""
    stale = [name for name, text in FILES.items() if not _is_current(IMAGES / name, text)]
    check = "--check" in sys.argv[1:]
    for name in stale:
        if not check:
            (IMAGES / name).write_text(FILES[name], "utf-8")
        print(f"docs/images/{name} {'is out of date: python hardware/wiring.py' if check else 'written'}")
    return int(check and bool(stale))


def _is_current(file: Path, text: str) -> bool:
    return file.is_file() and file.read_text("utf-8") == text


if __name__ == "__main__":
    sys.exit(main())
