"""Files that a test writes while a process reads them."""

import os
from pathlib import Path


def replace_text(file: Path, text: str) -> None:
    """Replace a file's text in one step: a process that reads it at any moment finds the old text or the new one."""
    written = file.with_name(f"{file.name}.{os.getpid()}")
    written.write_text(text)
    written.replace(file)
