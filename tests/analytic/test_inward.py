"""The penalty on motion away from the recordings, against fields whose motion is known."""

import numpy as np
import pytest
import torch

from iflow_gym import Demonstrations
from iflow_gym.baselines.imitation_flow.data import Draws, Recordings, Task
from iflow_gym.baselines.imitation_flow.inward import N_STATES, RATE, REACH, Inward
from iflow_gym.baselines.imitation_flow.passes import Encoded


def circle() -> tuple[Inward, Recordings, Draws]:
    """A circle in space, shown three times."""
    angle = 2 * np.pi * np.arange(200) / 200
    path = np.stack([np.cos(angle), np.sin(angle), 0.01 * np.cos(3 * angle)], axis=1)
    motion = Demonstrations.from_arrays([path] * 3, dt=0.01, period=2.0)
    data = Recordings([Task([motion])], torch.device("cpu"))
    draws = Draws([np.random.default_rng(0)], 4 * N_STATES, torch.device("cpu"))
    return Inward(data), data, draws


def penalty(inward, draws, field):
    """The term of a step, of a system with this velocity field; and the states it asked for."""
    draws.new_step()
    term = inward(draws)
    points = next(term)
    asked = term.send(Encoded(points.states, torch.zeros_like(points.recordings)))
    moved = asked.z + asked.times[:, None] * field(inward, points.states)
    with pytest.raises(StopIteration) as end:
        term.send(moved)
    return end.value.value, points.states


def towards(rate):
    return lambda inward, y: -rate * inward._from_nearest(y)[0]


def test_what_closes_in_fast_enough_costs_nothing_and_what_leads_away_does() -> None:
    inward, _, draws = circle()
    assert penalty(inward, draws, towards(1.01 * RATE))[0].item() == 0.0
    slow = penalty(circle()[0], draws, towards(0.5 * RATE))[0].item()
    away = penalty(circle()[0], draws, towards(-RATE))[0].item()
    assert 0 < slow < away


def test_penalty_is_the_squared_excess_over_the_rate() -> None:
    inward, _, draws = circle()
    value, y = penalty(inward, draws, towards(0.0))
    distance = inward._from_nearest(y)[1]
    excess = torch.where(distance > 0.1, RATE * distance / (2 * np.pi), 0.0)
    assert value.item() == pytest.approx(excess.square().mean().item(), rel=1e-4)


def test_motion_beside_the_recordings_is_free() -> None:
    """On a circle's axis-parallel cylinder, going round changes no distance to the circle."""
    inward, _, draws = circle()

    def round_and_in(inward, y):
        x = torch.stack([-y[:, 1], y[:, 0], torch.zeros_like(y[:, 0])], 1)
        return 2 * np.pi * x - 1.5 * RATE * inward._from_nearest(y)[0]

    value, _ = penalty(inward, draws, round_and_in)
    assert value.item() < 1e-2


def test_worst_states_are_looked_at_again() -> None:
    inward, data, draws = circle()
    first = penalty(inward, draws, towards(0.0))[1]
    again = penalty(inward, draws, towards(0.0))[1]
    assert (first.shape[-1], again.shape[-1]) == (N_STATES // 2, N_STATES)
    far = inward._from_nearest(first)[1].max()
    assert torch.isclose(inward._from_nearest(again)[1].max(), far) or (
        inward._from_nearest(again)[1].max() > far
    )
    bound = data.centre.abs() + REACH * data.half
    assert bool((again.abs() <= bound + 1e-6).all())
