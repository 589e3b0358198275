"""What simulated sensor nodes run here: the firmware's code, or a model where that can't be compiled."""

from collections.abc import Callable

from fognav import system


def prepare(print_line: Callable[[str], None], *, yes: bool = False) -> None:
    """Compile the firmware's core; where that can't be, print one line with the reason.

    A missing compiler is installed if the user agrees (`yes`: without asking).
    """
    from fognav_sim.nodes import why_model  # noqa: PLC0415  # keeps the other commands fast

    reason = why_model()
    if reason is not None and _lacks_compiler():
        try:
            system.ensure([system.COMPILER], yes=yes, print_line=print_line)
        except system.NoAttemptError:
            pass  # the reason says how to install it
        except system.MissingToolsError as error:
            print_line(str(error))
        else:
            reason = why_model()
    if reason is not None:
        print_line(f"simulated sensor nodes run a model in Python, not the firmware: {reason.splitlines()[0]}")


def _lacks_compiler() -> bool:
    """Whether there are sources to compile, and nothing that could."""
    from fognav_sim.nodes import FirmwareError, find_compiler, find_firmware  # noqa: PLC0415  # same

    try:
        find_firmware()
    except FirmwareError:
        return False
    try:
        find_compiler()
    except FirmwareError:
        return True
    return False
