"""Layers that are looked up, against layers whose units are evaluated."""

import pickle

import numpy as np
import pytest
from imitation_flow_parts import as_field, flow_arrays, random_flow

from iflow_gym.baselines.imitation_flow.fields import coupling, coupling_table
from iflow_gym.baselines.imitation_flow.fields.coupling_table import REACH


@pytest.fixture
def by_units(monkeypatch):
    """Calls a method of a field as if no table were faster."""

    def called(method, *points):
        with monkeypatch.context() as patch:
            patch.setattr(coupling, "TABULATED", np.inf)
            return method(*points)

    return called


def states(d, scale, n=400):
    return scale * np.random.default_rng(0).normal(size=(n, d))


@pytest.mark.parametrize("d", [2, 3])
class TestATabulatedFlow:
    @pytest.mark.parametrize("scale", [0.5, REACH, 1e3])
    def test_is_the_flow(self, d, scale, by_units):
        """Within the table, in and out of it, and outside."""
        field, z = as_field(flow_arrays(random_flow(d))), states(d, scale)
        table = field._table
        outside = np.isnan(table.forward(z)).any(axis=1)
        assert outside.any() == (scale > 1)
        assert outside.all() == (scale > 100)
        y = field.forward(z)
        back, log_det = field.inverse(y)
        expected, expected_log_det = by_units(field.inverse, y)
        inside = ~outside
        np.testing.assert_array_equal(y[inside], table.forward(z)[inside])
        np.testing.assert_allclose(y, by_units(field.forward, z), rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose(back, expected, rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose(log_det, expected_log_det, rtol=0, atol=1e-9)

    def test_has_its_origin_where_the_flow_has_it(self, d):
        """So a goal is at rest in a batch as it is alone."""
        field = as_field(flow_arrays(random_flow(d)))
        origin, _ = field.inverse(np.zeros((1, d)))
        goals = np.zeros((200, d))
        np.testing.assert_allclose(field.inverse(goals)[0], origin + goals, rtol=0, atol=1e-14)
        np.testing.assert_allclose(field.forward(origin + goals), goals, rtol=0, atol=1e-14)

    def test_is_left_to_units_where_states_are_few(self, d, by_units):
        field, z = as_field(flow_arrays(random_flow(d))), states(d, 1.0, coupling.TABULATED - 1)
        np.testing.assert_array_equal(field.forward(z), by_units(field.forward, z))
        assert "_table" not in vars(field)

    def test_is_no_part_of_copies(self, d):
        field, z = as_field(flow_arrays(random_flow(d))), states(d, 1.0)
        y = field.forward(z)
        text = pickle.dumps(field)
        assert len(text) < 50_000
        np.testing.assert_array_equal(pickle.loads(text).forward(z), y)

    def test_is_inverted_to_rounding(self, d):
        """Since the way back divides by what the way there multiplied with."""
        field, z = as_field(flow_arrays(random_flow(d))), states(d, 1.0)
        np.testing.assert_allclose(field.inverse(field.forward(z))[0], z, rtol=0, atol=1e-13)

    def test_has_answers_of_units_where_it_is_outside(self, d, by_units):
        field, z = as_field(flow_arrays(random_flow(d))), states(d, 1.0)
        z[7], z[8, 0], z[9] = 10 * REACH, -np.inf, np.nan
        with np.errstate(invalid="ignore"):
            y, exact = field.forward(z), by_units(field.forward, z[7:10])
        np.testing.assert_allclose(y[7], exact[0], rtol=1e-14)
        np.testing.assert_array_equal(np.isnan(y).any(axis=1), np.arange(len(z)) // 2 == 4)
        np.testing.assert_array_equal(np.isnan(exact).any(axis=1), [False, True, True])

    def test_in_blocks_is_the_same(self, d, monkeypatch):
        field, z = as_field(flow_arrays(random_flow(d))), states(d, 1.0)
        whole = [field.forward(z), *field.inverse(z)]
        monkeypatch.setattr(coupling_table, "BLOCK", 150)
        for a, b in zip([field.forward(z), *field.inverse(z)], whole, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)


def test_functions_too_steep_for_the_table_are_evaluated(by_units):
    arrays = flow_arrays(random_flow(2))
    arrays["hidden_weight"][3] *= 1e3
    field, z = as_field(arrays), states(2, 1.0)
    assert field._table is None
    np.testing.assert_array_equal(field.forward(z), by_units(field.forward, z))


def test_a_larger_table_where_a_small_one_does_not_do(by_units):
    arrays = flow_arrays(random_flow(2))
    arrays["hidden_weight"][3] *= 3
    field, z = as_field(arrays), states(2, 1.0)
    small, large = (
        coupling_table.CouplingTable(field.arrays, field.bound, np.zeros(2), n).error
        for n in coupling_table.N_CELLS
    )
    assert large < coupling_table.TOLERANCE < small < 2.0**7 * large
    assert field._table.error == large
    np.testing.assert_allclose(field.forward(z), by_units(field.forward, z), rtol=0, atol=1e-9)


def test_scales_whose_product_has_no_logarithm_are_evaluated(by_units):
    field, y = as_field(flow_arrays(random_flow(2)), bound=50), states(2, 1.0)
    assert field._table is None
    np.testing.assert_array_equal(field.inverse(y)[1], by_units(field.inverse, y)[1])


def test_two_kept_coordinates_are_no_table(by_units):
    field, z = as_field(flow_arrays(random_flow(5))), states(5, 1.0)
    np.testing.assert_array_equal(field.forward(z), by_units(field.forward, z))
