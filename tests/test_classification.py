"""Classification by densities of trajectories: exact ones, poses, and the change of variables."""

import numpy as np
import pytest

from iflow_gym import Demonstrations
from iflow_gym.classification import Pose, TrajectoryClassifier, varied


class Spiral:
    """An exact density: around the turned state, from a normal start; axes of two sizes."""

    def __init__(self, size, rate, centre=(0.0, 0.0), noise=0.1):
        self.size, self.rate, self.noise = np.broadcast_to(size, 2), rate, noise
        self.centre = np.array(centre)

    def trajectory_log_prob(self, x, dt, *, stride=1, initial=False):
        z = (np.asarray(x)[::stride] - self.centre) / self.size
        angle = self.rate * stride * dt
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        variance = self.noise**2 * stride * dt
        off = np.sum((z[1:] - z[:-1] @ turn.T) ** 2, axis=1)
        total = np.sum(-off / (2 * variance) - np.log(2 * np.pi * variance * self.size.prod()))
        if initial:
            total += -np.sum(z[0] ** 2) / 2 - np.log(2 * np.pi * self.size.prod())
        return float(total)


def rounds(size, period, centre=(0.0, 0.0), n=3, wave=0.0, n_rounds=3.3, dt=0.02):
    paths = []
    for k in range(n):
        angle = k + 2 * np.pi * np.arange(round(n_rounds * period / dt)) * dt / period
        radius = size * (1 + wave * np.cos(3 * angle))
        paths.append(np.array(centre) + (radius * [np.cos(angle), np.sin(angle)]).T)
    return Demonstrations.from_arrays(paths, dt=dt, period=period, name="rounds")


def two():
    motions = {"slow": rounds(1.0, 2.0), "fast": rounds(1.0, 1.0, n_rounds=6.6)}
    models = {"slow": Spiral(1.0, np.pi), "fast": Spiral(1.0, 2 * np.pi)}
    return models, motions


class TestPose:
    def test_of_a_circle(self):
        motion = rounds(2.5, 1.6, centre=(3.0, -1.0), n_rounds=4)
        pose = Pose.of(motion.positions[0], 0.02, cyclic=True)
        np.testing.assert_allclose(pose.place, [3.0, -1.0], atol=0.01)
        assert pose.size == pytest.approx(2.5, rel=1e-3)
        assert pose.time == pytest.approx(1.6, rel=0.01)

    def test_of_a_motion_that_ends(self):
        path = np.column_stack([np.linspace(-3, 0, 31), np.zeros(31)]) + 5.0
        pose = Pose.of(path, 0.1, cyclic=False)
        np.testing.assert_allclose(pose.place, [5.0, 5.0])
        assert pose.size == pytest.approx(np.sqrt(np.mean(np.linspace(-3, 0, 31) ** 2)))
        assert pose.time == pytest.approx(3.0)

    def test_recordings_have_the_geometric_mean(self):
        motion = varied(rounds(1.0, 2.0), scale=4.0)
        pair = Demonstrations.from_arrays(
            [*rounds(1.0, 2.0).positions, *motion.positions], dt=0.02, period=2.0
        )
        assert Pose.of_demonstrations(pair).size == pytest.approx(2.0, rel=0.01)

    def test_what_stays_in_one_place_has_none(self):
        with pytest.raises(ValueError, match="Expected a trajectory that moves"):
            Pose.of(np.ones((50, 2)), 0.1, cyclic=False)


class TestClassifier:
    def test_the_likelier_model_and_its_confusion(self):
        models, motions = two()
        classifier = TrajectoryClassifier(models)
        np.testing.assert_array_equal(classifier.confusion(motions), [[3, 0], [0, 3]])
        swapped = {"slow": motions["fast"], "fast": motions["slow"]}
        np.testing.assert_array_equal(classifier.confusion(swapped), [[0, 3], [3, 0]])
        path = motions["slow"].positions[0]
        expected = [m.trajectory_log_prob(path, 0.02, initial=True) for m in models.values()]
        np.testing.assert_allclose(classifier.log_probs(path, 0.02), expected)

    @pytest.mark.parametrize("horizon", [0.0, 0.2])
    def test_a_pose_is_removed_and_its_jacobian_kept(self, horizon):
        """p(x) = p(x / s) / s^d for each sample, and neither tempo nor place count."""
        models, motions = two()
        classifier = TrajectoryClassifier(models, motions, horizon=horizon)
        path = motions["slow"].positions[1]
        before = classifier.log_probs(path, 0.02)
        moved = 7.0 + 3.0 * path
        n_scored = -(-len(path) // max(1, round(horizon / 0.02)))
        np.testing.assert_allclose(
            classifier.log_probs(moved, 0.02), before - 2 * n_scored * np.log(3.0), rtol=1e-9
        )
        if not horizon:
            np.testing.assert_allclose(classifier.log_probs(path, 0.05), before, rtol=1e-9)

    def test_a_model_in_other_units_is_the_same_class(self):
        """Ten times as large demonstrations and model: the density of a trajectory stays."""
        models, motions = two()
        ten = varied(motions["fast"], scale=10.0)
        centre = np.concatenate(ten.positions).mean(axis=0)
        one = TrajectoryClassifier(models, motions)
        other = TrajectoryClassifier(
            {"slow": models["slow"], "fast": Spiral(10.0, 2 * np.pi, centre=-9 * centre)},
            {"slow": motions["slow"], "fast": ten},
        )
        path = motions["fast"].positions[0]
        np.testing.assert_allclose(other.log_probs(path, 0.02), one.log_probs(path, 0.02))

    def test_shapes_are_told_apart_at_another_size_and_tempo(self):
        """A circle at the tempo of the oval is taken for the oval until its tempo is removed."""
        axes = np.array([1.1, 0.9])
        models = {"circle": Spiral(1.0, np.pi), "oval": Spiral(axes, 1.4 * np.pi)}
        circles = rounds(1.0, 2.0)
        ovals = [axes * path for path in rounds(1.0, 2.0 / 1.4).positions]
        motions = {
            "circle": circles,
            "oval": Demonstrations.from_arrays(ovals, dt=0.02, period=2.0 / 1.4),
        }
        shown = {
            "circle": varied(circles, scale=0.5, tempo=1.4),
            "oval": varied(motions["oval"], scale=2.0, tempo=1 / 1.4),
        }
        posed, plain = TrajectoryClassifier(models, motions), TrajectoryClassifier(models)
        np.testing.assert_array_equal(posed.confusion(shown), [[3, 0], [0, 3]])
        np.testing.assert_array_equal(plain.confusion(shown), [[0, 3], [3, 0]])
        assert (posed.accuracy(shown), plain.accuracy(shown)) == (1.0, 0.0)

    def test_what_cannot_be_is_refused(self):
        models, motions = two()
        ends = Demonstrations.from_arrays([np.linspace([-1.0, 0.0], [0.0, 0.0], 20)], dt=0.1)
        with pytest.raises(ValueError, match="at least one model"):
            TrajectoryClassifier({})
        with pytest.raises(ValueError, match=r"demonstrations of \['fast', 'slow'\], got"):
            TrajectoryClassifier(models, {"slow": motions["slow"]})
        with pytest.raises(ValueError, match="all end or all repeat"):
            TrajectoryClassifier(models, motions | {"fast": ends})
        with pytest.raises(ValueError, match="horizon >= 0"):
            TrajectoryClassifier(models, horizon=-1.0)


class TestVaried:
    def test_size_and_tempo_change_about_the_mean(self):
        motion = rounds(1.0, 2.0, centre=(4.0, 0.0))
        made = varied(motion, scale=0.7, tempo=1.4)
        assert made.period == pytest.approx(2.0 / 1.4)
        assert made.peak_speed == pytest.approx(0.7 * 1.4 * motion.peak_speed)
        means = [np.concatenate(m.positions).mean(0) for m in (motion, made)]
        np.testing.assert_allclose(means[1], means[0])
        slopes = np.gradient(made.positions[0], made.dt[0], axis=0)
        np.testing.assert_allclose(slopes[1:-1], made.velocities[0][1:-1], atol=1e-9)

    def test_what_cannot_be_is_refused(self):
        ends = Demonstrations.from_arrays([np.linspace([-1.0, 0.0], [0.0, 0.0], 20)], dt=0.1)
        with pytest.raises(ValueError, match="recordings that repeat"):
            varied(ends, scale=0.7)
        with pytest.raises(ValueError, match="finite scale and tempo > 0, got 0"):
            varied(rounds(1.0, 2.0), scale=0)
