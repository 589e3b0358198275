"""How certain poses are as seen from one another."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fog_kernels.certainty import Neighbours


def test_the_surest_way_counts_with_what_its_turns_add_at_the_lever_of_each_step():
    ends = np.array([(0, 1), (2, 1), (0, 2)])
    figures = np.array([(0.1, 7.0, 0.01, 4.0), (8.0, 0.2, 0.02, 1.0), (9.0, 9.0, 0.5, 0.0)])
    variance, turned = Neighbours(4, ends, figures).seen_from(0)
    assert variance == pytest.approx([0.0, 0.1, 0.1 + 0.2 + 0.01 * 1.0, math.inf])
    assert turned == pytest.approx([0.0, 0.01, 0.03, math.inf])
    near, _ = Neighbours(4, ends, figures).seen_from(0, 0.2)
    assert near[1] == variance[1]
    assert near[2] > 0.2, "nobody wants to know more than that"


def test_a_pair_of_poses_that_are_none_is_refused():
    with pytest.raises(ValueError, match="poses 0 to 1"):
        Neighbours(2, np.array([(0, 2)]), np.ones((1, 4)))
