"""Pairs of tiles and Gaussians: sorted, drawn, and what tiles pull at them."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.pictures.blending import TILE_PIXELS, block_kernels, tile_kernels
from npa_envs.kernels.pictures.gaussians import PULLS, gaussian_kernels
from npa_envs.sph.bridge import launch, scalar_type
from npa_envs.sph.cells import LARGEST_INDEX


def _room(ends: Tensor, pairs_per_particle: int) -> int:
    """Return how many pairs a picture has room for."""
    if pairs_per_particle:
        return ends.shape[1] * pairs_per_particle
    return max(int(ends[:, -1].max()), 1)


class Pairs(NamedTuple):
    """Pairs of a tile and a Gaussian that covers it: by tile, near Gaussians first."""

    overflow: Tensor
    """Whether pairs of a picture found no room, shape [B V]."""
    slots: Tensor
    """First slot of each Gaussian in each picture, -1 without one, int32, shape [B V N]."""
    starts: Tensor
    """First pair of each tile of each picture, and the end, int32."""
    owners: Tensor
    """Picture and Gaussian of each pair, counted through, int32, shape [slots]."""
    places: Tensor
    """Slot of each pair, int64, shape [slots]."""


def sort_pairs(
    frame: Any, footprints: Tensor, depths: Tensor, counts: Tensor, pairs_per_particle: int
) -> Pairs:
    """Sort the pairs of pictures, whose depths and counts of tiles have shape [B V, N].

    Both sorts are stable: Gaussians of the same depth stay in the order of their indices.
    """
    device, images = depths.device, depths.shape[0]
    order = torch.sort(depths, dim=1, stable=True).indices
    ends = torch.cumsum(counts.gather(1, order), 1, dtype=torch.int64)
    room = _room(ends, pairs_per_particle)
    if images * room * PULLS > LARGEST_INDEX:
        raise NPAError(
            f"pairs of tiles and Gaussians must stay below {LARGEST_INDEX // PULLS} in one batch, "
            f"got room for {room} in each of {images} pictures: split the batch or lower "
            f"pairs_per_particle"
        )
    tile_end = images * frame.tile_count
    tiles = torch.full((images * room,), tile_end, dtype=torch.int32, device=device)
    owners = torch.zeros_like(tiles)
    slots = torch.empty_like(counts)
    arguments = (footprints, order.view(-1), ends.view(-1), room, tiles, owners, slots.view(-1))
    kernels = gaussian_kernels(scalar_type(depths.dtype))
    launch(kernels.list_pairs, counts.numel(), device, frame, *arguments)
    tiles, places = torch.sort(tiles, stable=True)
    starts = torch.searchsorted(
        tiles, torch.arange(tile_end + 1, dtype=torch.int32, device=device), out_int32=True
    )
    return Pairs(ends[:, -1] > room, slots.view(-1), starts, owners[places], places)


def blend(frame: Any, footprints: Tensor, pairs: Pairs, images: int) -> tuple[Tensor, ...]:
    """Return colours [B V H W, K], what passes and where a pixel stops, [B V H W]."""
    device, pixels = footprints.device, images * frame.width * frame.height
    scalar = scalar_type(footprints.dtype)
    listed = (pairs.starts, pairs.owners, footprints)
    if device.type == "cuda":
        picture = footprints.new_empty(pixels, frame.channels)
        passing = footprints.new_empty(pixels)
        stops = torch.empty(pixels, dtype=torch.int32, device=device)
        threads = images * frame.tile_count * TILE_PIXELS
        drawn = (*listed, picture, passing, stops)
        kernel = block_kernels(scalar).draw_blocks
        launch(kernel, threads, device, frame, *drawn, block_dim=TILE_PIXELS)
    else:
        picture = footprints.new_zeros(pixels, frame.channels)
        passing = footprints.new_ones(pixels)
        stops = torch.full((pixels,), LARGEST_INDEX, dtype=torch.int32, device=device)
        drawn = (*listed, picture, passing, stops)
        launch(tile_kernels(scalar).draw_tiles, images * frame.tile_count, device, frame, *drawn)
    return picture, passing, stops


def pull_back_tiles(
    frame: Any,
    footprints: Tensor,
    pairs: tuple[Tensor, ...],
    drawn: tuple[Tensor, Tensor],
    bars: tuple[Tensor, Tensor],
) -> Tensor:
    """Return what tiles pull at Gaussians, a row for each slot; empty slots are undefined."""
    device = footprints.device
    starts, owners, places = pairs
    passing, stops = drawn
    picture_bar, passing_bar = bars
    pulls = footprints.new_empty(owners.shape[0], PULLS)
    tiles = starts.shape[0] - 1
    listed = (starts, owners, places, footprints, stops, picture_bar)
    scalar = scalar_type(footprints.dtype)
    if device.type == "cuda":
        kernel = block_kernels(scalar).pull_back_blocks
        pulled = (*listed, passing, passing_bar, pulls.view(-1))
        launch(kernel, tiles * TILE_PIXELS, device, frame, *pulled, block_dim=TILE_PIXELS)
    else:
        pulled = (*listed, passing.clone(), passing * passing_bar, pulls)
        launch(tile_kernels(scalar).pull_back_tiles, tiles, device, frame, *pulled)
    return pulls
