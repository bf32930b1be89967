"""`Particles`: the positions, states, path lengths and goals of a batch of worlds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor


class Particles(NamedTuple):
    """The particles of a batch: B worlds of N particles each."""

    x: Tensor
    """Positions [length units], shape [B, N, D]."""
    s: Tensor
    """States, dimensionless, shape [B, N, C]."""
    path_length: Tensor | None = None
    """Length of each particle's path since the rollout began [length units], shape [B, N]."""
    goal: Tensor | None = None
    """Index of the target that each world is to become, int64, shape [B]; the last field."""

    def with_zero_paths(self, zeros: Tensor | None = None) -> Particles:
        """Return the worlds with path lengths of 0: the tensor `zeros` [B, N], or a new one."""
        zeros = self.x.new_zeros(self.x.shape[:2]) if zeros is None else zeros
        return self.with_fields(path_length=zeros)

    def with_fields(self, **values: Tensor | None) -> Particles:
        """Return the worlds with other values of some fields; unlike `_replace` it compiles."""
        x, s, path, goal = self
        take = values.get
        return Particles(take("x", x), take("s", s), take("path_length", path), take("goal", goal))  # type: ignore[arg-type]

    def moved(self, x: Tensor, s: Tensor, path_length: Tensor) -> Particles:
        """Return the worlds with other positions, states and path lengths."""
        return Particles(x, s, path_length, *self[3:])

    def per_particle(self) -> tuple[Tensor, Tensor, Any]:
        """Return x, s and the path lengths, in the order that `update_particles` takes."""
        return self.x, self.s, self.path_length

    def tensors(self) -> list[Tensor]:
        """Return the fields that are not None."""
        return [value for value in self if value is not None]

    def map(self, function: Callable[[Tensor], Tensor]) -> Particles:
        """Return worlds with a function applied to every field that is not None."""
        x, s, *rest = (None if value is None else function(value) for value in self)
        assert x is not None
        assert s is not None
        return Particles(x, s, *rest)

    def take(self, worlds: Tensor) -> Particles:
        """Return copies of the worlds with these indices, int64, 1D."""
        return self.map(lambda value: value.index_select(0, worlds))

    def put_(self, worlds: Tensor, other: Particles) -> None:
        """Overwrite the worlds with these indices, int64, 1D, by those of `other`, in place."""
        for field, new in zip(self.tensors(), other.tensors(), strict=True):
            field.index_copy_(0, worlds, new)

    def where(self, worlds: Tensor, other: Particles) -> Particles:
        """Return these worlds where `worlds`, bool, shape [B], is True, and `other` elsewhere."""
        others = iter(other.tensors())
        return self.map(
            lambda value: torch.where(worlds.view(-1, *[1] * (value.ndim - 1)), value, next(others))
        )

    def equal(self, other: Particles) -> Tensor:
        """Return which worlds equal those of `other`, except path lengths, bool, shape [B]."""
        ours, theirs = (worlds._replace(path_length=None).tensors() for worlds in (self, other))
        pairs = zip(ours, theirs, strict=True)
        return torch.stack([(a == b).flatten(1).all(dim=1) for a, b in pairs]).all(dim=0)

    def gather(self, order: Tensor) -> Particles:
        """Return the particles in another order: indices of all B N, int64; differentiable."""
        fields = self._replace(goal=None).map(
            lambda value: value.flatten(0, 1).index_select(0, order).view_as(value)
        )
        return fields._replace(goal=self.goal)

    def split(self, counts: Sequence[int]) -> list[Particles]:
        """Return each species' worlds, of `counts[k]` consecutive particles for species k."""
        fields = [
            [None] * len(counts) if value is None else torch.split(value, [*counts], dim=1)
            for value in self.per_particle()
        ]
        species = (Particles(*each) for each in zip(*fields, strict=True))
        return [worlds._replace(goal=self.goal) for worlds in species]

    def copy_(self, other: Particles) -> None:
        """Overwrite all these worlds by `other`, in place, by one kernel."""
        torch._foreach_copy_(self.tensors(), other.tensors())


def combined(function: Callable[[list[Tensor]], Tensor], parts: Sequence[Particles]) -> Particles:
    """Return several batches of worlds as one, each field by `torch.stack` or `torch.cat`."""
    fields = zip(*(part.tensors() for part in parts), strict=True)
    return parts[0].map(lambda _: function([*next(fields)]))
