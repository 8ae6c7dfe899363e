r"""The projection that keeps a base's Lyapunov function falling, whatever is added to its command.

Let x' = u be the motion that a velocity command brings about, c the base's command, r what is to be
added to it, V the base's Lyapunov function and rho > 0 a required rate.

**In continuous time.** Let r be changed as little as possible, in the Euclidean norm, so that

    <grad V, c + r> <= b,    b = max(-rho V, <grad V, c>).

The set is a half-space in r that holds r = 0, so the projection has the closed form

    r* = r - max(<grad V, c + r> - b, 0) grad V / ||grad V||^2.

(The half-space is the one that Kolter & Manek, "Learning stable deep dynamics models", NeurIPS
2019, eq. 10, project a field onto.) Proposition: where the base's own command has
<grad V, c> <= -rho V, as ImitationFlow's field has with rho <= 2 lambda, lambda its slowest decay,

    dV/dt = <grad V, c + r*> <= -rho V,    so    V(x(t)) <= exp(-rho t) V(x(0)),

for every measurable r(t), bounded or not (where a speed limit slows the base's field, at the slowed
field's rate, which is negative, too). With V positive definite and radially unbounded about the
goal x*, x* is globally asymptotically stable, uniformly over all agents. For a motion that repeats
V is the squared latent distance from the cycle, grad V has no part along the level sets of V, and
so only what leads away from the cycle is taken off: from every state but the image of the axis,
where V has a kink, the state approaches the cycle, and how fast it goes round is the agent's
choice, which may hold it or turn it back. Proof: Gronwall's inequality, and
<grad V, c + r*> = min(<grad V, c + r>, b).

**At a time step dt.** The command is held, so x_next = x + dt u and the half-space alone allows V
to rise by O(dt^2). So what it leaves of r is then shortened, r** = t r* with t in [0, 1], until

    V(x + dt (c + r**)) <= exp(-rho dt) V(x),    or else    t = 0.

Proposition: V(x_{k+1}) <= exp(-rho dt) V(x_k), or x_{k+1} is exactly where the base alone goes. The
base of an exact flow goes to phi_{s dt}(x), s in (0, 1] the share of time that its speed limit
leaves (`iflow_gym.policy.DynamicalSystemPolicy`), where V <= exp(-2 lambda s dt) V(x). Hence

    V(x_{k+1}) <= exp(-min(rho, 2 lambda s_k) dt) V(x_k) < V(x_k)    for x_k off the attractor,

and since s is bounded below on every sublevel set, V falls to 0 exponentially from everywhere: a
guarantee at this dt, without a limit. It is checked, not estimated, so that no curvature of V and
no error of grad V can break it; both only decide how much of r is kept. What is shortened stays on
the segment from c to c + r*, along which V is found by the chord: exact as a bound where V is
convex along the segment, which it is at the length of a step, and tried again where it is not.

**A tube round a cycle.** On the cycle V = 0 may not rise at all, and a straight step that is longer
than the base's leaves a curved orbit: nothing could be added. There V may rise up to a level V_0,
`LyapunovFunction.floor`: with max(exp(-rho dt) V, V_0) for exp(-rho dt) V above, V falls to V_0 as
it did to 0, and stays below it. For motions that end V_0 = 0.

**What is assumed.** That the state is carried to x + dt u: by the point mass in velocity mode, up
to rounding, as long as u is within its speed limit (r is shortened for that, too) and no wall is
touched. A mass that must be pushed, or an arm, follows its command with an error e: then V is
certain to fall for the commanded velocity only, and dV/dt <= -rho V + ||grad V|| ||e|| bounds the
state ultimately, by a level that grows with the error, instead of bringing it to rest at x*. How
close it comes to the goal there is measured, not proved.

**Where a plant does not follow**, a residual that is harmless to the command may still keep the
state on its way round and round. So for a motion that ends, r = 0 while V(x(t)) is above

    W(t) = S exp(-rho t / 2) V(x(0)),    S = `SLACK`:

an agent has a say only as long as what was measured keeps up with what was commanded, at half the
rate and within twice the latent distance. (A supervisor that falls back on a controller that is
trusted: Sha, "Using simplicity to control complexity", IEEE Software 18(4), 2001.) Proposition: W
falls to 0, so whatever the plant and the agent, at any time t either V(x(t)) <= W(t) or the base
alone commands: no agent keeps the state away from the goal for ever where the base alone, from
wherever it is left, would bring it there. Where commands are carried out exactly and no speed limit
slows the base, V <= exp(-rho t) V(x(0)) < W(t), and nothing is taken off.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from iflow_gym.demonstrations import FloatArray
from iflow_gym.residual.bases import BoolArray

RATE_SHARE = 0.9
"""Default of the required rate, as a share of the base's own slowest. A smaller one lets the agent
come to rest later; all of it leaves no room where the base itself falls at just that rate."""

CHORDS = 4
"""How often what is added is shortened before the base's own command is taken."""

SLACK = 4.0
"""S: so many times its start's the measured V may be. Chosen by the disturbed mass on Sshape,
seed 3: under its base alone V kept within 3.4 exp(-rho t / 2) V(x(0)) from every start of the
scored grid, and under an agent that kept the mass from the goal it did not."""

INSIDE = 1 - 1e-12
"""Commands stay this far below the speed limit, so that rounding carries none beyond it."""


class LyapunovFunction(Protocol):
    """A Lyapunov function V of a base, in closed form, for n states x, shape (n, d)."""

    @property
    def decay(self) -> float:
        """The rate in 1/s with dV/dt <= -decay V along the base's own field."""

    @property
    def floor(self) -> float:
        """The level of V up to which it may rise, >= 0: 0 for a motion that ends."""

    def value(self, x: FloatArray) -> FloatArray:
        """Return V(x) >= 0, shape (n,)."""

    def value_and_gradient(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return V(x), shape (n,), and its gradient, shape (n, d)."""


class LyapunovShield:
    """Changes what an agent adds to a base's velocity command so that V falls (see the module).

    Parameters
    ----------
    lyapunov : LyapunovFunction
        Of the base.
    max_speed : float, length/s
        Largest component of a command, > 0.
    rate_share : float
        rho as a share, in (0, 1], of the base's own slowest rate, `lyapunov.decay`. The smaller it
        is, the more the agent may slow the motion down; how far it may go astray is bounded by
        the start's level of V in any case.
    """

    def __init__(
        self, lyapunov: LyapunovFunction, max_speed: float, rate_share: float = RATE_SHARE
    ) -> None:
        if not 0 < rate_share <= 1:
            raise ValueError(f"Expected rate_share in (0, 1], got {rate_share!r}.")
        if not (np.isfinite(max_speed) and max_speed > 0):
            raise ValueError(f"Expected max_speed > 0 and finite, got {max_speed!r}.")
        self.lyapunov = lyapunov
        self.max_speed = float(max_speed)
        self.rate_share = float(rate_share)
        self.rate = self.rate_share * lyapunov.decay

    def allowance(
        self, x: FloatArray, dt: FloatArray, before: FloatArray | None, begun: BoolArray
    ) -> FloatArray:
        """Return W, up to which an agent has a say, shape (n,); infinite for a motion that repeats.

        Parameters
        ----------
        x : array, shape (n, d)
            Positions.
        dt : array, shape (n,)
            Seconds since W was `before`.
        before : array, shape (n,), or None
            W then; None where all begin.
        begun : array of bool, shape (n,)
            Where an episode begins at x.
        """
        if self.lyapunov.floor > 0:
            return np.full(len(x), np.inf)
        if before is None:
            return SLACK * self.lyapunov.value(x)
        found = np.exp(-self.rate / 2 * dt) * before
        if begun.any():
            found[begun] = SLACK * self.lyapunov.value(x[begun])
        return np.asarray(found)

    def kept(
        self,
        x: FloatArray,
        command: FloatArray,
        added: FloatArray,
        dt: FloatArray,
        allowance: FloatArray | None = None,
    ) -> FloatArray:
        """Return what is kept of an addition to a command, shape (n, d) in length/s.

        Parameters
        ----------
        x : array, shape (n, d)
            Positions.
        command : array, shape (n, d)
            c in length/s, of the base's exact flow or slowed along it, within `max_speed`.
        added : array, shape (n, d)
            r in length/s; finite.
        dt : array, shape (n,)
            Seconds that the command will be held.
        allowance : array, shape (n,), optional
            W: nothing is kept where V(x) is above it.
        """
        level, gradient = self.lyapunov.value_and_gradient(x)
        if allowance is not None:
            added = np.where((level <= allowance)[:, None], added, 0.0)
        floor = self.lyapunov.floor
        slope = np.maximum(-self.rate * level, (floor - level) / dt)
        kept = projected(command, added, gradient, slope)
        kept = within_speed(command, kept, self.max_speed)
        bound = np.maximum(np.exp(-self.rate * dt) * level, floor)
        return self._shortened(x, command, kept, dt, bound)

    def _shortened(
        self, x: FloatArray, c: FloatArray, r: FloatArray, dt: FloatArray, bound: FloatArray
    ) -> FloatArray:
        """Return t r with V(x + dt (c + t r)) <= bound, or 0."""
        moving = np.flatnonzero((r != 0).any(axis=1))
        if not len(moving):
            return r
        reached = self.lyapunov.value(x[moving] + dt[moving, None] * (c + r)[moving])
        bad = moving[~(reached <= bound[moving])]  # what is not finite, too
        if not len(bad):
            return r
        r = r.copy()
        ends = reached[~(reached <= bound[moving])]
        base = self.lyapunov.value(x[bad] + dt[bad, None] * c[bad])
        room = bound[bad] - base
        for _ in range(CHORDS):
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                share = np.where(room > 0, INSIDE * room / (ends - base), 0.0)
            share = np.where(np.isfinite(share), np.clip(share, 0.0, 1.0), 0.0)
            r[bad] *= share[:, None]
            ends = self.lyapunov.value(x[bad] + dt[bad, None] * (c + r)[bad])
            still = ~(ends <= bound[bad])
            if not still.any():
                return r
            bad, ends, base, room = bad[still], ends[still], base[still], room[still]
        r[bad] = 0.0
        return r


def projected(
    command: FloatArray, added: FloatArray, gradient: FloatArray, bound: FloatArray
) -> FloatArray:
    """Return the r nearest to `added` with <gradient, command + r> <= b, shape (n, d).

    b is `bound`, shape (n,), or the command's own <gradient, command> where that is greater; the
    other three have shape (n, d). Where the gradient is 0 nothing is changed.
    """
    own = np.einsum("ni,ni->n", gradient, command)
    slope = np.einsum("ni,ni->n", gradient, added)
    excess = slope - np.maximum(bound - own, 0.0)
    square = np.einsum("ni,ni->n", gradient, gradient)
    over = (excess > 0) & (square > 0)
    factor = np.where(over, excess, 0.0) / np.where(over, square, 1.0)
    return np.asarray(added - factor[:, None] * gradient)


def within_speed(command: FloatArray, added: FloatArray, max_speed: float) -> FloatArray:
    """Return t r, t in [0, 1] the largest with no component of c + t r beyond `max_speed`.

    c and r are `command` and `added`, shape (n, d); of a command at its limit nothing is kept that
    leads beyond it.
    """
    room = np.maximum(INSIDE * max_speed - np.sign(added) * command, 0.0)
    size = np.abs(added)
    shares = np.where(size > room, room / np.where(size > 0, size, 1.0), 1.0)
    return np.asarray(added * shares.min(axis=1, keepdims=True))
