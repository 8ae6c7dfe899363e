"""The emission y = h(z): what every normalizing flow here has in common.

A flow is a chain of layers, each behind an orthogonal transform (Kingma & Dhariwal, "Glow", 2018),

    h = h_L . R_L . ... . h_1 . R_1,    R = exp(S - S^T),

and trains many models at once: every tensor has the model as its leading dimension m and the points
last, (m, d, n), so that a batch of models is one set of batched matrix products over long rows.
What a layer is, is the subclass's: `coupling` (Dinh et al. 2017), `autoregressive` (Papamakarios et
al. 2017), `spline` (Durkan et al. 2019).

A context c (m, k, n) is an input of every layer's conditioner beside the coordinates that it may
see: for each context h(., c) is a diffeomorphism, so that what holds for h holds for each context.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable


class Flow(nn.Module, ABC):
    """`n_models` flows of dimension d that share nothing but their shapes.

    Parameters
    ----------
    n_dims, n_layers : int
        Sizes; n_dims >= 2.
    generators : list of torch.Generator
        One a model, so that a model starts the same whatever trains beside it.
    """

    def __init__(self, n_dims: int, n_layers: int, generators: list[torch.Generator]) -> None:
        super().__init__()
        self.n_dims, self.n_layers, self.n_models = n_dims, n_layers, len(generators)
        self._generators = generators
        n_angles = n_dims * (n_dims - 1) // 2
        self.angles = nn.Parameter(math.pi * (2 * self.drawn(n_layers, n_angles) - 1))

    def drawn(self, *shape: int, normal: bool = False) -> Tensor:
        """Return uniform or normal numbers of shape (shape[0], m, *shape[1:])."""
        draw = torch.randn if normal else torch.rand
        single = torch.float32  # whatever the process's default is
        return torch.stack([draw(*shape, generator=g, dtype=single) for g in self._generators], 1)

    def orthogonal(self) -> Tensor:
        """Return R of every layer, shape (layers, m, d, d)."""
        d = self.n_dims
        if d == 2:
            rotations: Tensor = _Rotations.apply(self.angles)
            return rotations
        skew = self.angles.new_zeros(*self.angles.shape[:2], d, d)
        rows, columns = torch.triu_indices(d, d, 1)
        skew[..., columns, rows] = self.angles
        return torch.linalg.matrix_exp(skew - skew.mT)

    def rotations(self, model: int) -> NDArray[np.float64]:
        """Return one model's R, (layers, d, d): the orthogonal matrices nearest to float32's."""
        left, _, right = torch.linalg.svd(self.orthogonal()[:, model].detach().double())
        return (left @ right).cpu().numpy()

    def weights(self) -> Any:
        """Return what both directions make of the parameters, to be made once for both."""
        return None

    @abstractmethod
    def forward(self, z: Tensor, context: Tensor | None = None, weights: Any = None) -> Tensor:
        """Return y = h(z), both (m, d, n), for contexts (m, k, n)."""

    @abstractmethod
    def arrays(self, model: int, context: Tensor | None = None) -> dict[str, NDArray[np.float64]]:
        """Return one model's arrays for its NumPy twin, a context (k,) folded into the biases."""

    @abstractmethod
    def inverse(
        self, y: Tensor, context: Tensor | None = None, weights: Any = None
    ) -> tuple[Tensor, Tensor]:
        """Return z = h^-1(y), (m, d, n), and log |det dz/dy|, (m, n)."""


class _Rotations(torch.autograd.Function):
    """Rotations by angles (..., 1), shape (..., 2, 2), as one node."""

    @staticmethod
    def forward(ctx: Any, angles: Tensor) -> Tensor:
        cos, sin = torch.cos(angles), torch.sin(angles)
        rotations = torch.cat([cos, sin, -sin, cos], dim=-1)
        ctx.save_for_backward(rotations)
        return rotations.unflatten(-1, (2, 2))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> Tensor:
        (rotations,) = ctx.saved_tensors
        cos, sin = rotations[..., :1], rotations[..., 1:2]
        first, above, below, last = g.flatten(-2).split(1, -1)
        return (above - below) * cos - (first + last) * sin
