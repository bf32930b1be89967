"""Codes: vectors that tell a rule of many pictures which one to grow."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from npa_envs.errors import NPAError, check_known, shown

MAX_CODE_COUNT = 65536
"""Largest number of codes of a rule."""

PICTURE_SIDE = 32
"""Side of the pictures that an encoder reads [pixels]."""

WIDTHS = (16, 32, 64)
"""Channels of an encoder's layers, each of which halves the picture's side."""


class Codes(nn.Module):
    """The codes of a rule of many pictures: a vector of `code_dim` numbers for each picture's name.

    A code, in about [-1, 1] (dimensionless), tells the rule which picture to grow. It is the first
    state channels of each particle, which the rule perceives and never changes. Codes are
    parameters, or a trained network, the encoder, computes them from any pictures.
    """

    table: Tensor
    """A code for each name, shape [names, code_dim]: parameters, or the encoder's last outputs."""

    def __init__(self, names: Sequence[str], dim: int, *, encoder: bool = False) -> None:
        super().__init__()
        self.names = tuple(names)
        """Names of the codes, in the order of `table`."""
        table = torch.empty(len(names), dim).uniform_(-1.0, 1.0)
        if encoder:
            self.register_buffer("table", table.zero_())
        else:
            self.table = nn.Parameter(table)
        self.encoder = PictureEncoder(dim) if encoder else None
        """Computes codes from pictures; None where codes are parameters."""

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> Tensor:
        """Return the code of the picture called `name`, shape [code_dim]."""
        check_known("unknown code", name, self.names)
        return self.table[self.names.index(name)]

    def blend(self, shares: Mapping[str, float]) -> Tensor:
        """Return the weighted mean of codes, shape [code_dim]; `shares` maps names to weights."""
        total = sum(shares.values())
        if not (math.isfinite(total) and total > 0.0):
            raise NPAError(
                f"shares must be finite and add up to more than 0, got {shown(dict(shares))}: "
                "give each name a weight such as 0.5"
            )
        parts = [share / total * self[name] for name, share in shares.items()]
        return torch.stack(parts).sum(dim=0)

    def encode(self, pictures: Tensor) -> Tensor:
        """Return the encoder's codes of pictures [B, R, R, 4], [B, code_dim]; differentiable."""
        if self.encoder is None:
            raise NPAError("this rule has no encoder: train one with encoder=True (--encoder)")
        if pictures.ndim != 4 or pictures.shape[3] != 4 or pictures.shape[1] != pictures.shape[2]:
            raise NPAError(
                f"pictures must have shape [B, R, R, 4], got {tuple(pictures.shape)}: for one "
                "picture add a dimension with picture[None]"
            )
        codes: Tensor = self.encoder(pictures)
        return codes


def replace_code(states: Tensor, code: Tensor) -> Tensor:
    """Return states [..., C] whose first channels are `code`, [code_dim] to [..., code_dim]."""
    expanded = code.to(states).expand(*states.shape[:-1], code.shape[-1])
    return torch.cat((expanded, states[..., code.shape[-1] :]), dim=-1)


def checked_names(names: Any) -> tuple[str, ...]:
    """Return `names` as a tuple; raise NPAError unless they are a list of different strings."""
    is_list = isinstance(names, Collection) and not isinstance(names, str)
    if not is_list or not all(isinstance(name, str) for name in names):
        raise NPAError(
            f"code_names must be a list of names, got {shown(names)}: for example ['gecko', "
            "'heart'], or () for a rule without codes"
        )
    if len(set(names)) < len(names) or len(names) > MAX_CODE_COUNT:
        raise NPAError(
            f"code_names must be different names, at most {MAX_CODE_COUNT}, got "
            f"{shown([*names])}: leave one of each"
        )
    return tuple(names)


class PictureEncoder(nn.Module):
    """A small convolutional network that maps a picture to a code, in [-1, 1]."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        channels = (4, *WIDTHS)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, 3, stride=2, padding=1) for before, after in pairwise(channels)
        )
        side = PICTURE_SIDE >> len(WIDTHS)
        self.output = nn.Linear(WIDTHS[-1] * side * side, dim)

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the codes of pictures [B, R, R, 4], shape [B, code_dim]."""
        planes = F.adaptive_avg_pool2d(
            pictures.to(self.output.weight).permute(0, 3, 1, 2), PICTURE_SIDE
        )
        for convolution in self.convolutions:
            planes = torch.relu(convolution(planes))
        code: Tensor = torch.tanh(self.output(planes.flatten(1)))
        return code
