"""The sound of hits: where, how high and how loud they are heard."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.io import wavfile

from iflow_gym.envs.drumming.sound import FOURTH, HIGHEST, LOUDEST, RATE, sound, write_sound
from iflow_gym.metrics.drumming import Hit


def test_hits_are_heard_when_they_come():
    heard = np.abs(sound([Hit(0.5, 0, 8.0), Hit(2.5, 1, 8.0)])).max(axis=1)
    loud = np.flatnonzero(heard > 0.02)
    assert 0.5 <= loud[0] / RATE < 0.502
    again = loud[loud > 2.0 * RATE]
    assert 2.5 <= again[0] / RATE < 2.502
    assert not heard[: RATE // 2].any()
    assert heard[int(1.9 * RATE) : int(2.5 * RATE)].max() < 0.005  # it has died away


@pytest.mark.parametrize("drum", [0, 1])
def test_each_drum_has_its_pitch_and_its_side(drum):
    heard = sound([Hit(0.0, drum, 5.0)])
    spectrum = np.abs(np.fft.rfft(heard.sum(axis=1)))
    peak = np.fft.rfftfreq(len(heard), 1 / RATE)[spectrum.argmax()]
    assert peak == pytest.approx(HIGHEST * FOURTH**drum, abs=1.0)
    left, right = np.abs(heard).max(axis=0)
    assert (right > left) == (drum == 0)


def test_a_harder_hit_is_louder_and_none_too_loud():
    heard = np.abs(sound([Hit(0.0, 0, 4.0), Hit(2.0, 0, 8.0)])).max(axis=1)
    soft, hard = heard[:RATE].max(), heard[2 * RATE :].max()
    assert hard == pytest.approx(LOUDEST)
    assert soft == pytest.approx(LOUDEST / 2, rel=1e-3)


def test_as_long_as_is_asked_for():
    assert sound([], seconds=0.25).shape == (RATE // 4, 2)
    assert not sound([], seconds=0.25).any()
    assert sound([Hit(0.2, 0, 5.0), Hit(9.0, 1, 5.0)], seconds=0.25).shape == (RATE // 4, 2)


def test_file(tmp_path):
    hits = [Hit(0.1, 0, 5.0), Hit(0.4, 1, 9.0)]
    rate, samples = wavfile.read(write_sound(tmp_path / "drums.wav", hits))
    assert rate == RATE
    np.testing.assert_allclose(samples / 32767, sound(hits), atol=1 / 32767)


def test_errors(tmp_path):
    with pytest.raises(ValueError, match=r"drums 0 to 1, got some of \[2\]"):
        sound([Hit(0.0, 2, 5.0)])
    with pytest.raises(ValueError, match="seconds > 0, got -1"):
        sound([], seconds=-1.0)
    with pytest.raises(ValueError, match=r"ends with \.wav"):
        write_sound(tmp_path / "drums.mp3", [])
