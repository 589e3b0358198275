"""What all tests share: how hypothesis looks for examples."""

import os

from hypothesis import settings

# A run that judges a change must come out the same twice; on a developer's machine every run looks further.
settings.register_profile("repeatable", derandomize=True)
if os.environ.get("CI", "").lower() in {"1", "true"}:
    settings.load_profile("repeatable")
