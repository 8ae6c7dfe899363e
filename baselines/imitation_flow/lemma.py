"""A numerical check of the paper's Lemma 1: LV(y) = LU(h^-1(y)) for V = U o h^-1.

The lemma is true, and by Ito's formula it is no more than the chain rule. The paper's proof has two
omissions: eq. (5) lacks Ito's term 1/2 sum_ij (g g^T)_ij d_ij h in the drift, and V_yy is printed
as J^-T U_zz J^-1, without the term sum_k U_{z_k} D^2 (h^-1)_k. But h^-1(h(z)) = z, twice
differentiated, is

    sum_l d_l (h^-1)_k d_ij h_l + D^2 (h^-1)_k [J e_i, J e_j] = 0,

so in LV the two terms are equal and opposite, for every h, U, f and g: both omitted, the sum is
still LU exactly. Corrected alone, either is wrong: the full Hessian with the printed drift is off
by 1/2 V_y sum_ij (g g^T)_ij d_ij h, and on random flows has the wrong sign at some states.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.func import jacrev, vmap

Point = Callable[[Tensor], Tensor]


class Generators(NamedTuple):
    """The generator of a system at n states, each (n,), by four routes."""

    latent: Tensor
    """LU = U_z f + 1/2 tr(g^T U_zz g)."""
    observed: Tensor
    """LV with Ito's drift and the full Hessian of V."""
    printed: Tensor
    """LV with the paper's drift (eq. 5) and the paper's Hessian."""
    mixed: Tensor
    """LV with the paper's drift and the full Hessian: what eqs. (3) and (5) say as they stand."""


def generators(
    forward: Point, inverse: Point, lyapunov: Point, z: Tensor, drift: Tensor, diffusion: Tensor
) -> Generators:
    """Return LU and LV at states z of a latent system, LV computed in observed space by autograd.

    Parameters
    ----------
    forward, inverse : callables
        h and h^-1 of one point (d,), of operations that torch differentiates twice.
    lyapunov : callable
        U of one point: (d,) to a scalar.
    z, drift, diffusion : tensors, shapes (n, d), (n, d), (n, d, d)
        Latent states, with f and g there (Ito).
    """

    def at(z: Tensor, f: Tensor, g: Tensor) -> tuple[Tensor, ...]:
        y, jacobian = forward(z), jacrev(forward)(z)
        bent = torch.einsum("ik,jk,lij->l", g, g, jacrev(jacrev(forward))(z))
        gradient, full = jacrev(value)(y), jacrev(jacrev(value))(y)
        u_z, u_zz = jacrev(lyapunov)(z), jacrev(jacrev(lyapunov))(z)
        back = torch.linalg.inv(jacobian)
        moved, noise = jacobian @ f, jacobian @ g
        return (
            u_z @ f + _half_trace(g, u_zz),
            gradient @ (moved + bent / 2) + _half_trace(noise, full),
            gradient @ moved + _half_trace(noise, back.mT @ u_zz @ back),
            gradient @ moved + _half_trace(noise, full),
        )

    def value(y: Tensor) -> Tensor:
        return lyapunov(inverse(y))

    return Generators(*vmap(at)(z, drift, diffusion))


def _half_trace(noise: Tensor, second: Tensor) -> Tensor:
    return torch.einsum("ik,ij,jk->", noise, second, noise) / 2
