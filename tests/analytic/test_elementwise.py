"""exp, exp2 and tanh in place, against NumPy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from iflow_gym.baselines.elementwise import exp2_, exp_, tanh_

VALUES = arrays(np.float64, array_shapes(min_dims=1, max_dims=2, min_side=0), elements=st.floats())


@pytest.mark.parametrize(("ours", "numpys"), [(exp_, np.exp), (exp2_, np.exp2), (tanh_, np.tanh)])
@given(values=VALUES)
def test_they_are_numpys_to_rounding_and_in_place(ours, numpys, values):
    with np.errstate(over="ignore", invalid="ignore"):
        expected = numpys(values)
    found = ours(values)
    assert found is values
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=5e-16)
