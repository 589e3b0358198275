"""The digest of hazards: the same in any order; another for another area, seq, state or penalty."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from fog_contracts.messages import AggregatorHeartbeat, AreaHazard, hazards_digest

HAZARDS = st.lists(
    st.builds(
        AreaHazard, area=st.from_regex(r"[a-z][a-z0-9]{0,5}", fullmatch=True), state=st.just("clear"),
        severity=st.just(0), penalty=st.integers(0, 254), since=st.just(0.0), seq=st.integers(0, 2**53),
        epoch=st.just(1), cause=st.just(""),
    ),
    max_size=8, unique_by=lambda hazard: hazard.area,
)  # fmt: skip


@given(HAZARDS, st.randoms(use_true_random=False))
def test_digest_does_not_depend_on_the_order_and_fits_into_the_heartbeat(hazards, order):
    shuffled = list(hazards)
    order.shuffle(shuffled)
    assert hazards_digest(shuffled) == hazards_digest(hazards)
    AggregatorHeartbeat(epoch=1, areas={}, complete=True, digest=hazards_digest(hazards), uptime=0.0, stamp=0.0)
    assert 0 <= hazards_digest(hazards) < 2**63


@pytest.mark.parametrize("change", [{"seq": 8}, {"state": "unknown"}, {"penalty": 1}, {"area": "gate"}])
def test_digest_covers_area_seq_state_and_penalty(change):
    hazard = AreaHazard(
        area="hall", state="clear", severity=0, penalty=0, since=0.0, seq=7, epoch=1, cause="", nodes={"n1": "clear"}
    )
    assert hazards_digest([structs.replace(hazard, **change)]) != hazards_digest([hazard])
    assert hazards_digest([structs.replace(hazard, cause="another", since=5.0)]) == hazards_digest([hazard])
