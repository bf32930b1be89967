"""Codes: the numbers that say which picture a rule of many pictures grows."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from npa_envs.errors import NPAError, shown, suggest

LARGEST_CODE_COUNT = 65536
"""No rule knows more codes by name."""

PICTURE_SIDE = 32
"""Pixels on each side of the pictures that an encoder reads."""

WIDTHS = (16, 32, 64)
"""Channels of an encoder's layers, each of which halves the picture."""


class Codes(nn.Module):
    """Codes by name, each of `dim` numbers in about [-1, 1] (dimensionless).

    A code is state that a rule perceives and never changes: the first `code_dim` channels of each
    particle. It is learned by itself, or a trained network, the encoder, reads it from a picture,
    so that a picture that was never trained on has one too.
    """

    table: Tensor
    """The codes, shape [T, K]: learned, or what the encoder said last of the pictures."""

    def __init__(self, names: Sequence[str], dim: int, *, encoder: bool = False) -> None:
        super().__init__()
        if len(set(names)) < len(names) or len(names) > LARGEST_CODE_COUNT:
            raise NPAError(
                f"code_names must be different names, at most {LARGEST_CODE_COUNT}, got "
                f"{shown(list(names))}: leave one of each"
            )
        self.names = tuple(names)
        """What each code stands for."""
        table = torch.empty(len(names), dim).uniform_(-1.0, 1.0)
        if encoder:
            self.register_buffer("table", table.zero_())
        else:
            self.table = nn.Parameter(table)
        self.encoder = PictureEncoder(dim) if encoder else None
        """Reads codes from pictures, where the rule was trained with one."""

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: object) -> bool:
        """Return whether a code has this name."""
        return name in self.names

    def __iter__(self) -> Iterator[str]:
        """Return the names, one by one."""
        return iter(self.names)

    def __getitem__(self, name: str) -> Tensor:
        """Return the code of a name, shape [K]."""
        if name not in self.names:
            raise NPAError(f"unknown code {shown(name)}: {suggest(name, self.names)}")
        return self.table[self.names.index(name)]

    def blend(self, shares: Mapping[str, float]) -> Tensor:
        """Return the mean of codes, each weighted by its share, shape [K]."""
        total = sum(shares.values())
        if not (math.isfinite(total) and total > 0.0):
            raise NPAError(
                f"shares must be finite and add up to more than 0, got {shown(dict(shares))}: "
                "give each name a weight such as 0.5"
            )
        parts = [share / total * self[name] for name, share in shares.items()]
        return torch.stack(parts).sum(dim=0)

    def encode(self, pictures: Tensor) -> Tensor:
        """Return the codes of pictures, shape [B, K], differentiable."""
        if self.encoder is None:
            raise NPAError("this rule has no encoder: train one with encoder=True (--encoder)")
        if pictures.ndim != 4 or pictures.shape[3] != 4 or pictures.shape[1] != pictures.shape[2]:
            raise NPAError(
                f"pictures must have shape [B, R, R, 4], got {tuple(pictures.shape)}: for one "
                "picture add a dimension with picture[None]"
            )
        codes: Tensor = self.encoder(pictures)
        return codes


def carrying(states: Tensor, code: Tensor) -> Tensor:
    """Return states [..., C] that begin with a code, of a shape that expands to [..., K]."""
    carried = code.to(states).expand(*states.shape[:-1], code.shape[-1])
    return torch.cat((carried, states[..., code.shape[-1] :]), dim=-1)


def check_names(names: object) -> None:
    """Check that what codes are to be called is several texts."""
    given = names if isinstance(names, Collection) and not isinstance(names, str) else None
    if given is None or not all(isinstance(name, str) for name in given):
        raise NPAError(
            f"code_names must be a list of names, got {shown(names)}: for example ['gecko', "
            "'heart'], or () for a rule without codes"
        )


class PictureEncoder(nn.Module):
    """A small convolutional network from a picture to a code in [-1, 1]."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        channels = (4, *WIDTHS)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(given, made, 3, stride=2, padding=1) for given, made in pairwise(channels)
        )
        side = PICTURE_SIDE >> len(WIDTHS)
        self.output = nn.Linear(WIDTHS[-1] * side * side, dim)

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the codes of pictures [B, R, R, 4], shape [B, K]."""
        planes = F.adaptive_avg_pool2d(
            pictures.to(self.output.weight).permute(0, 3, 1, 2), PICTURE_SIDE
        )
        for convolution in self.convolutions:
            planes = torch.relu(convolution(planes))
        code: Tensor = torch.tanh(self.output(planes.flatten(1)))
        return code
