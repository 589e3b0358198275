"""Recorded logs of lidars, and the options of the commands that read them: a command line is read without numba."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

Format = Literal["auto", "intel", "jsonl", "carmen", "rosbag2", "fognav"]
Selection = Literal["all", "odd", "even"]
Poses = Literal["matched", "reference"]
LogFormat = Annotated[
    Format, typer.Option("--format", help="Format of the log; intel is JSON lines, auto looks at the file.")
]
Scans = Annotated[Selection, typer.Option("--scans", help="Scans to use: all, or those with odd or even numbers.")]
RangeMax = Annotated[
    float, typer.Option("--range-max", metavar="M", min=1.0, max=200.0, help="Longer ranges are not used (m).")
]
