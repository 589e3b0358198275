"""How examples of property tests are run."""

from hypothesis import HealthCheck, settings


def test_no_example_fails_for_taking_long():
    """Hypothesis gives an example 200 ms by default, unless it runs in CI."""
    assert settings().deadline is None
    assert HealthCheck.too_slow in settings().suppress_health_check
