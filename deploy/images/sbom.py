"""Write an image's software bill of materials (CycloneDX): its Python packages, Debian's packages, and Fognav itself.

    cyclonedx-py environment … -o python.json PYTHON; python sbom.py python.json /var/lib/dpkg/status VERSION

Show it: docker run --rm --entrypoint cat fognav/planner /opt/fognav/sbom.json
"""

import json
import sys
from email.parser import HeaderParser
from pathlib import Path
from urllib.parse import quote


def debian(status: str) -> list[dict[str, str]]:
    """Return the installed packages in dpkg's list as components."""
    entries = (HeaderParser().parsestr(text) for text in status.split("\n\n") if text.strip())
    return [
        {
            "type": "library",
            "bom-ref": purl,
            "name": str(entry["Package"]),
            "version": str(entry["Version"]),
            "purl": purl,
        }
        for entry in entries
        if str(entry["Status"]).endswith(" installed")
        for purl in [f"pkg:deb/debian/{entry['Package']}@{quote(str(entry['Version']))}?arch={entry['Architecture']}"]
    ]


def main() -> None:
    """Complete the list of Python packages, and print it."""
    python, status, version = (Path(argument).read_text("utf-8") for argument in sys.argv[1:])
    found = json.loads(python)
    found["components"] += debian(status)
    found.setdefault("metadata", {})["component"] = {
        "type": "application", "bom-ref": "fognav", "name": "fognav", "version": version.strip(),
    }  # fmt: skip
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
