"""The emission y = h(z): affine coupling layers between orthogonal transforms, many models at once.

Every tensor has the model as its leading dimension m, so that a batch of models is one set of
batched matrix products. A layer is

    u = R z,    y_a = u_a,    y_b = u_b exp(s(u_a)) + t(u_a),    s = c tanh(s^ / c),

with R orthogonal (R = exp(S - S^T)) and s^, t of one hidden layer of tanh units (Dinh et al.,
"Density estimation using Real NVP", 2017; Kingma & Dhariwal, "Glow", 2018, for the transforms
between). The units saturate, so far from the demonstrations every layer is an affine map whose
scale lies between exp(-c) and exp(c): h is a diffeomorphism of the whole space, its inverse is
exact in floating point, and the field far away is calm.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class CouplingFlow(nn.Module):
    """`n_models` flows of dimension d that share nothing but their shapes.

    Parameters
    ----------
    n_models, n_dims, n_layers, n_hidden : int
        Sizes; n_dims >= 2.
    log_scale_bound : float
        The bound c.
    sharpness : float
        Initial slope of the hidden units.
    generators : list of torch.Generator
        One a model, so that a model starts the same whatever trains beside it.
    """

    def __init__(
        self,
        n_models: int,
        n_dims: int,
        n_layers: int,
        n_hidden: int,
        *,
        log_scale_bound: float,
        sharpness: float,
        generators: list[torch.Generator],
    ) -> None:
        super().__init__()
        self.n_dims, self.n_layers, self.log_scale_bound = n_dims, n_layers, log_scale_bound
        self.n_kept = n_dims // 2
        n_moved = n_dims - self.n_kept

        def drawn(*shape: int, normal: bool = False) -> Tensor:
            draw = torch.randn if normal else torch.rand
            return torch.stack([draw(*shape, generator=g) for g in generators], dim=1)

        # Units are steps with random slopes (1 to 4 times the sharpness) and places.
        slopes = sharpness * (1 + 3 * drawn(n_layers, self.n_kept, n_hidden))
        slopes = slopes * torch.sign(drawn(n_layers, self.n_kept, n_hidden) - 0.5)
        places = 1.3 * (2 * drawn(n_layers, self.n_kept, n_hidden) - 1)
        self.hidden_weight = nn.Parameter(slopes / math.sqrt(self.n_kept))
        self.hidden_bias = nn.Parameter(-(self.hidden_weight * places).detach().sum(2, True))
        self.out_weight = nn.Parameter(0.01 * drawn(n_layers, n_hidden, 2 * n_moved, normal=True))
        self.out_bias = nn.Parameter(torch.zeros(n_layers, n_models, 1, 2 * n_moved))
        n_angles = n_dims * (n_dims - 1) // 2
        self.angles = nn.Parameter(math.pi * (2 * drawn(n_layers, n_angles) - 1))

    def orthogonal(self) -> Tensor:
        """Return R of every layer, shape (layers, m, d, d), for row vectors on its left."""
        d = self.n_dims
        if d == 2:
            cos, sin = torch.cos(self.angles[..., 0]), torch.sin(self.angles[..., 0])
            return torch.stack([cos, -sin, sin, cos], dim=-1).unflatten(-1, (2, 2))
        skew = self.angles.new_zeros(*self.angles.shape[:2], d, d)
        rows, columns = torch.triu_indices(d, d, 1)
        skew[..., rows, columns] = self.angles
        return torch.linalg.matrix_exp(skew - skew.mT)

    def _coefficients(self, layer: int, kept: Tensor) -> tuple[Tensor, Tensor]:
        """Log-scale and shift, each (m, n, moved), from the kept coordinates (m, n, kept)."""
        hidden = torch.tanh(torch.baddbmm(self.hidden_bias[layer], kept, self.hidden_weight[layer]))
        out = torch.baddbmm(self.out_bias[layer], hidden, self.out_weight[layer])
        raw, shift = out.tensor_split(2, dim=-1)
        return self.log_scale_bound * torch.tanh(raw / self.log_scale_bound), shift

    def forward(self, z: Tensor) -> Tensor:
        """Return y = h(z), both (m, n, d)."""
        for layer, rotation in enumerate(self.orthogonal()):
            kept, moved = torch.bmm(z, rotation).split((self.n_kept, z.shape[-1] - self.n_kept), -1)
            log_scale, shift = self._coefficients(layer, kept)
            z = torch.cat([kept, torch.addcmul(shift, moved, torch.exp(log_scale))], dim=-1)
        return z

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return z = h^-1(y), (m, n, d), and log |det dz/dy|, (m, n)."""
        rotations = self.orthogonal()
        log_det = y.new_zeros(y.shape[:-1])
        for layer in reversed(range(self.n_layers)):
            kept, moved = y.split((self.n_kept, y.shape[-1] - self.n_kept), -1)
            log_scale, shift = self._coefficients(layer, kept)
            moved = (moved - shift) * torch.exp(-log_scale)
            log_det = log_det - log_scale.sum(-1)
            y = torch.bmm(torch.cat([kept, moved], dim=-1), rotations[layer].mT)
        return y, log_det
