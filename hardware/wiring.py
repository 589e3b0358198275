"""Draws the wiring of a sensor node, of a robot and of its cut-off as SVG files in `docs/images`.

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

    def contact(self, x: float, y: float, radius: float, number: str = "") -> None:
        """Draw a round contact, or with a large radius a plug's rim, and its number."""
        self.parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="{radius:g}" fill="#fff" stroke="#566573"/>')
        self.text(x, y + 5, number, anchor="middle", bold=True)

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


MINI_DIN: Final = {1: "Vpwr", 2: "Vpwr", 3: "RXD", 4: "TXD", 5: "BRC", 6: "GND", 7: "GND"}
"""The pins of a Roomba's socket (Open Interface specification)."""
_FACE: Final = {7: (-34, -26), 6: (0, -38), 5: (34, -26), 4: (-44, 8), 3: (44, 8), 2: (-16, 36), 1: (16, 36)}
"""Where they are as one looks into the socket, the row of three above, in pixels from its middle."""
FTDI: Final = {"GND": ("black", 6), "TXD": ("orange", 3), "RXD": ("yellow", 4), "RTS": ("green", 5)}
"""The wires of a TTL-232R-5V cable and the socket's pins that they lead to; red (5 V) and brown (CTS) stay free."""
_KINDS: Final = {"GND": "ground", "TXD": "trigger", "RXD": "echo", "RTS": "logic"}


def robot() -> str:
    """Return the wiring of a robot with serial adapters at USB: power bank, Raspberry Pi, Roomba and lidar."""
    drawing = Drawing(960, 560, "Wiring of a robot: power bank, Raspberry Pi, Roomba 600 and RPLidar A1")
    drawing.text(40, 30, "Robot: everything by USB", bold=True)
    drawing.box(40, 90, 150, 120, "power bank")
    drawing.text(56, 132, "5 V, 3 A, USB-C")
    drawing.pins(190, [(175, "output")], right=True)
    drawing.box(290, 60, 170, 300, "Raspberry Pi 4")
    drawing.pins(290, [(175, "USB-C")], right=False)
    drawing.pins(460, [(140, "USB"), (305, "USB")], right=True)
    drawing.wire("power", (190, 175), (290, 175))
    drawing.text(240, 166, "5 V", anchor="middle")
    drawing.box(530, 60, 160, 190, "TTL-232R-5V cable")
    drawing.pins(530, [(140, "USB")], right=False)
    drawing.wire("logic", (460, 140), (530, 140))
    heights = dict(zip(FTDI, (110, 145, 180, 215), strict=True))
    drawing.pins(690, [(heights[name], f"{name} {colour}") for name, (colour, _) in FTDI.items()], right=True)
    drawing.box(790, 60, 140, 300, "Roomba 600")
    rows = {pin: 110 + 35 * place for place, pin in enumerate((6, 3, 4, 5, 7, 1, 2))}
    drawing.pins(790, [(y, f"{pin} {MINI_DIN[pin]}") for pin, y in rows.items()], right=False)
    for name, (_, pin) in FTDI.items():
        drawing.wire(_KINDS[name], (690, heights[name]), (790, rows[pin]))
    drawing.text(782, rows[1] + 4, "leave free", anchor="end")
    drawing.text(782, rows[2] + 4, "leave free", anchor="end")
    drawing.wire("logic", (460, 305), (500, 305), (500, 440), (530, 440))
    drawing.box(530, 390, 160, 90, "adapter of the kit")
    drawing.pins(530, [(440, "micro USB")], right=False)
    drawing.pins(690, [(440, "7 pins")], right=True)
    drawing.wire("logic", (690, 440), (790, 440))
    drawing.box(790, 390, 140, 90, "RPLidar A1")
    drawing.pins(790, [(440, "cable")], right=False)
    drawing.text(40, 390, "Red (5 V) and brown (CTS) of the cable:", bold=True)
    drawing.text(40, 408, "cut off and insulated. The grounds of robot")
    drawing.text(40, 426, "and power bank are one by the black wire.")
    drawing.text(
        40, 510, "Blue: commands to the robot. Orange: its frames. Green to BRC: a low pulse of 1.2 s wakes it."
    )
    drawing.text(
        40,
        528,
        "The lidar takes its 5 V for core and motor from the Pi's USB socket: use a short cable, at most 0.5 m.",
    )
    return drawing.svg()


def robot_port() -> str:
    """Return the face of the robot's socket, and how a Raspberry Pi's own serial port is wired to it."""
    drawing = Drawing(960, 420, "A Roomba's serial socket, and a Raspberry Pi's own serial port at it")
    drawing.text(40, 30, "The robot's socket, seen from outside", bold=True)
    middle = (150, 150)
    drawing.contact(*middle, 78)
    for pin, (x, y) in _FACE.items():
        drawing.contact(middle[0] + x, middle[1] + y, 11, str(pin))
    for line, text in enumerate((
        "1, 2 Vpwr: the battery, 13 to 17 V, unregulated,",
        "200 mA at most: not for a Pi or a lidar",
        "3 RXD: to the robot, 5 V",
        "4 TXD: from the robot, 5 V",
        "5 BRC: low for 1 s wakes it; three pulses of",
        "50 to 500 ms change its rate to 19200",
        "6, 7 GND",
    )):  # fmt: skip
        drawing.text(40, 262 + 20 * line, text)
    drawing.text(430, 30, "Without a USB cable: by a level shifter, never directly", bold=True)
    drawing.box(430, 60, 150, 250, "Raspberry Pi")
    pi = {"3V3": 110, "5V": 145, "GPIO14": 180, "GPIO15": 215, "GND": 250}
    names = {"3V3": "1  3.3 V", "5V": "2  5 V", "GPIO14": "8  TXD", "GPIO15": "10  RXD", "GND": "6  GND"}
    drawing.pins(580, [(y, names[pin]) for pin, y in pi.items()], right=True)
    drawing.box(650, 60, 130, 250, "level shifter")
    drawing.pins(650, [(110, "LV"), (180, "LV1"), (215, "LV2"), (250, "GND")], right=False)
    drawing.pins(780, [(110, "HV"), (180, "HV1"), (215, "HV2"), (250, "GND")], right=True)
    drawing.box(840, 60, 100, 250, "Roomba")
    drawing.pins(840, [(180, "3 RXD"), (215, "4 TXD"), (250, "6 GND")], right=False)
    drawing.wire("power", (580, pi["3V3"]), (650, 110))
    drawing.wire("power", (580, pi["5V"]), (615, pi["5V"]), (615, 340), (810, 340), (810, 110), (780, 110))
    for kind, y in (("trigger", 180), ("echo", 215), ("ground", 250)):
        drawing.wire(kind, (580, y), (650, y))
        drawing.wire(kind, (780, y), (840, y))
    drawing.text(430, 372, 'With BSS138 or alike. BRC stays free (brc = "none"): CLEAN wakes the robot.')
    drawing.text(430, 392, 'port = "/dev/ttyAMA0", after dtoverlay=disable-bt, without a console on it.')
    return drawing.svg()


FILES: Final = {
    "node-wiring.svg": node("standard"),
    "node-wiring-thesis.svg": node("thesis"),
    "cut-off.svg": cut_off(),
    "robot-wiring.svg": robot(),
    "robot-port.svg": robot_port(),
}
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
