"""Pictures of 3D Gaussians as a differentiable torch operator."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import check_alike, check_floating, checked_count, checked_number, constant
from npa_envs.errors import NPAError, shown
from npa_envs.kernels.pictures.blending import TILE_PIXELS, block_kernels, tile_kernels
from npa_envs.kernels.pictures.gaussians import (
    CHANNELS,
    FOOTPRINT,
    TILE_BAR,
    gaussian_kernels,
    make_frame,
)
from npa_envs.ops.custom_op import check_derivatives, custom_op, once_differentiable
from npa_envs.ops.launch import SCALARS, is_traced, launch
from npa_envs.ops.pictures.cameras import Cameras
from npa_envs.ops.sort import MAX_INDEX


def check_gaussians(
    means: Tensor, scales: Tensor, quaternions: Tensor, opacities: Tensor, colours: Tensor
) -> None:
    """Check shapes, dtypes and devices of Gaussians; on the CPU also the scales' signs."""
    _check_tensor("means", means, means, "[B, N, 3]")
    lead = tuple(means.shape[:2])
    if means.ndim != 3 or means.shape[2] != 3 or 0 in lead:
        hint = "add a world dimension with means[None]" if means.ndim == 2 else "reshape it"
        raise NPAError(
            f"means must have shape [B, N, 3] with at least one world and one particle, "
            f"got {tuple(means.shape)}: {hint}"
        )
    shapes = (
        ("scales", scales, "[B, N, 3]", ((3,),)),
        ("quaternions", quaternions, "[B, N, 4]", ((4,),)),
        ("opacities", opacities, "[B, N]", ((),)),
        (
            "colours",
            colours,
            f"[B, N, F] with F from 1 to {CHANNELS}, or [B, N, 4, 3]",
            (*((k,) for k in range(1, CHANNELS + 1)), (4, 3)),
        ),
    )
    for name, tensor, shape, ends in shapes:
        _check_tensor(name, tensor, means, shape)
        if tuple(tensor.shape) not in [(*lead, *end) for end in ends]:
            raise NPAError(
                f"{name} must have shape {shape} with [B, N] = {list(lead)} as means has, "
                f"got {tuple(tensor.shape)}"
            )
    check_derivatives(means=means, **{name: tensor for name, tensor, *_ in shapes})
    if scales.device.type == "cpu" and not torch.compiler.is_compiling():
        negative = scales.detach() < 0.0
        if bool(negative.any()):
            world, particle, _ = (int(k) for k in negative.nonzero()[0])
            raise NPAError(
                f"scales must not be negative [length units], got "
                f"{scales[world, particle].tolist()} at world {world}, particle {particle} "
                f"({int(negative.any(-1).sum())} such particles): make them with exp or softplus"
            )


def _check_tensor(name: str, tensor: Tensor, means: Tensor, shape: str) -> None:
    check_floating(name, tensor, shape)
    check_alike(name, tensor, "means", means)


def check_cameras(
    cameras: Cameras, means: Tensor, background: Tensor | None, channels: int
) -> None:
    """Check that cameras and a background fit worlds of particles at `means` with F `channels`."""
    if not isinstance(cameras, Cameras):
        raise NPAError(
            f"cameras must be Cameras, got {type(cameras).__name__}: "
            f"make them with orbit, or Cameras(world_to_camera=..., intrinsics=..., ...)"
        )
    if cameras.world_to_camera.device != means.device:
        raise NPAError(
            f"cameras and means must share a device, got {cameras.world_to_camera.device} and "
            f"{means.device}: move them with cameras.to(means.device)"
        )
    if cameras.world_count not in (None, means.shape[0]):
        raise NPAError(
            f"cameras of their own must be there for each of {means.shape[0]} worlds, got "
            f"world_to_camera of shape {tuple(cameras.world_to_camera.shape)}: share cameras with "
            f"shape [V, 4, 4]"
        )
    image = (means.shape[0], cameras.count, cameras.height, cameras.width, channels)
    entries = means.shape[0] * cameras.count * max(means.shape[1], cameras.height * cameras.width)
    if entries * 12 > MAX_INDEX:
        raise NPAError(
            f"pictures and footprints must stay below {MAX_INDEX // 12} in one batch, got "
            f"{entries}, of {image[0]} worlds and {image[1]} views: split the batch"
        )
    if background is None:
        return
    _check_tensor("background", background, means, "that broadcasts to [B, V, H, W, F]")
    try:
        joined = torch.broadcast_shapes(background.shape, image)  # type: ignore[no-untyped-call]
        fits = tuple(joined) == image
    except RuntimeError:
        fits = False
    if not fits:
        raise NPAError(
            f"background must broadcast to [B, V, H, W, F] = {list(image)}, "
            f"got {tuple(background.shape)}: for example one colour of shape [{channels}]"
        )


class Pairs(NamedTuple):
    """Pairs of a tile and a Gaussian that covers it, sorted by tile and then by depth."""

    overflow: Tensor
    """Whether a picture has more pairs than slots, shape [B V]."""
    slots: Tensor
    """First slot of each Gaussian in each picture, -1 for none, int32, shape [B V N]."""
    starts: Tensor
    """First pair of each tile of each picture, and the end, int32."""
    owners: Tensor
    """Index of picture and Gaussian of each pair, among all B V N, int32, shape [slots]."""
    pair_slots: Tensor
    """Slot of each pair, int64, shape [slots]."""


def sort_pairs(
    frame: Any, footprints: Tensor, depths: Tensor, counts: Tensor, pairs_per_particle: int
) -> Pairs:
    """Return the pairs of all pictures, sorted by tile and depth; equal depths stay in order.

    `footprints`, [B V N, 12], describe Gaussians on the pictures. `depths` and `counts`, the number
    of tiles that each covers, have shape [B V, N]. `pairs_per_particle` 0: as many as there are.
    """
    device, images = depths.device, depths.shape[0]
    tile_end = images * frame.tile_count
    if is_traced():
        size: Any = counts.numel() * pairs_per_particle
        size = size if pairs_per_particle else torch.library.get_ctx().new_dynamic_size()
        slots, starts, owners = map(counts.new_empty, (counts.numel(), tile_end + 1, size))
        overflow = counts.new_empty(images, dtype=torch.bool)
        return Pairs(overflow, slots, starts, owners, owners.new_empty(size, dtype=torch.int64))
    order = torch.sort(depths, dim=1, stable=True).indices
    ends = torch.cumsum(counts.gather(1, order), 1, dtype=torch.int64)
    room = ends.shape[1] * pairs_per_particle or max(int(ends[:, -1].max()), 1)
    if images * room * TILE_BAR > MAX_INDEX:
        raise NPAError(
            f"pairs of tiles and Gaussians must stay below {MAX_INDEX // TILE_BAR} in one batch, "
            f"got room for {room} in each of {images} pictures: split the batch or lower "
            f"pairs_per_particle"
        )
    tiles = torch.full((images * room,), tile_end, dtype=torch.int32, device=device)
    owners = torch.zeros_like(tiles)
    slots = torch.empty_like(counts)
    arguments = (footprints, order.view(-1), ends.view(-1), room, tiles, owners, slots.view(-1))
    kernels = gaussian_kernels(SCALARS[depths.dtype])
    launch(kernels.list_pairs, counts.numel(), device, frame, *arguments)
    tiles, pair_slots = torch.sort(tiles, stable=True)
    starts = torch.searchsorted(
        tiles, torch.arange(tile_end + 1, dtype=torch.int32, device=device), out_int32=True
    )
    return Pairs(ends[:, -1] > room, slots.view(-1), starts, owners[pair_slots], pair_slots)


def blend(frame: Any, footprints: Tensor, pairs: Pairs, images: int) -> tuple[Tensor, ...]:
    """Return for each of B V H W pixels: colour [F], transmittance, index after its last pair."""
    device, pixels = footprints.device, images * frame.width * frame.height
    scalar = SCALARS[footprints.dtype]
    contents = (pairs.starts, pairs.owners, footprints)
    if device.type == "cuda":
        picture = footprints.new_empty(pixels, frame.channels)
        passing = footprints.new_empty(pixels)
        stops = torch.empty(pixels, dtype=torch.int32, device=device)
        threads = images * frame.tile_count * TILE_PIXELS
        drawn = (*contents, picture, passing, stops)
        kernel = block_kernels(scalar).draw_blocks
        launch(kernel, threads, device, frame, *drawn, block_dim=TILE_PIXELS)
    else:
        picture = footprints.new_zeros(pixels, frame.channels)
        passing = footprints.new_ones(pixels)
        stops = torch.full((pixels,), MAX_INDEX, dtype=torch.int32, device=device)
        drawn = (*contents, picture, passing, stops)
        launch(tile_kernels(scalar).draw_tiles, images * frame.tile_count, device, frame, *drawn)
    return picture, passing, stops


PAIRS_PER_PARTICLE = 8
"""Default room on CUDA, in pairs of a tile and a Gaussian for each Gaussian of a picture."""

DILATION = 0.3
"""Added to variances on the picture [pixels squared]: about the blur of a pixel (Kerbl et al.)."""


class GaussianPictures(NamedTuple):
    """Pictures that `render_gaussians` draws of worlds."""

    image: Tensor
    """Colours, dimensionless, shape [B, V, H, W, F]; the first row is the upper one."""
    alpha: Tensor
    """Opacity of each pixel, in [0, 1], shape [B, V, H, W]."""
    overflow: Tensor
    """Pictures without room for all pairs, whose farthest Gaussians are missing: bool, [B, V]."""


class GaussianScene(NamedTuple):
    """Tensors of Gaussians (without opacities) and of cameras."""

    means: Tensor
    scales: Tensor
    quaternions: Tensor
    colours: Tensor
    motions: Tensor
    intrinsics: Tensor

    def frame(self, width: int, height: int, near: float, dilation: float) -> Any:
        """Return the struct of sizes and constants that kernels read, the same for all pictures."""
        # As integers: symbolic sizes of torch.compile become constants, and others recompile.
        sizes = self.means.shape[1], self.motions.shape[-3], self.colours.shape[-1]
        shape = int(sizes[0]), int(sizes[1]), int(sizes[2])
        return make_frame(SCALARS[self.means.dtype], shape, (width, height), near, dilation)

    def flat(self) -> list[Tensor]:
        """Return the tensors as kernels read them, with B N particles, or B V cameras, first."""
        means, scales, quaternions, colours, motions, intrinsics = self
        total = means.shape[0] * means.shape[1]
        shapes = means.view(total, 3), scales.view(total, 3), quaternions.view(total, 4)
        return [*shapes, colours.view(total, -1), motions.view(-1, 4, 4), intrinsics.view(-1, 4)]


@custom_op("npa::gaussians")
def _gaussians(
    opacities: Tensor,
    tensors: list[Tensor],
    width: int,
    height: int,
    near: float,
    dilation: float,
    pairs_per_particle: int,
) -> list[Tensor]:
    """Return pictures, whether each lacked room for pairs, and tensors for the backward pass."""
    scene = GaussianScene(*tensors)
    means, frame = scene.means, scene.frame(int(width), int(height), near, dilation)
    worlds, views = means.shape[0], frame.view_count
    images, particles = worlds * views, means.shape[1]
    footprints = means.new_empty(images * particles, FOOTPRINT)
    depths = means.new_empty(images, particles)
    counts = torch.empty(images, particles, dtype=torch.int32, device=means.device)
    flat = scene.flat()
    projected = (footprints, depths.view(-1), counts.view(-1))
    kernels = gaussian_kernels(SCALARS[means.dtype])
    arguments = (*flat[:3], opacities.view(-1), *flat[3:], *projected)
    launch(kernels.project_gaussians, images * particles, means.device, frame, *arguments)
    pairs = sort_pairs(frame, footprints, depths, counts, pairs_per_particle)
    picture, passing, stops = blend(frame, footprints, pairs, images)
    return [
        picture.view(worlds, views, height, width, -1),
        pairs.overflow.view(worlds, views),
        passing.view(worlds, views, height, width),
        stops,
        footprints,
        counts.view(-1),
        *pairs[1:],
    ]


@custom_op("npa::gaussians_backward")
def _gaussians_backward(
    picture_bar: Tensor, passing_bar: Tensor, saved: list[Tensor], near: float, dilation: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the gradients of means, scales, quaternions, opacities and colours."""
    scene = GaussianScene(*saved[:6])
    passing, stops, footprints, counts, slots, starts, owners, pair_slots = saved[6:]
    device, scalar = footprints.device, SCALARS[footprints.dtype]
    frame = scene.frame(int(passing.shape[3]), int(passing.shape[2]), near, dilation)
    picture_bar = picture_bar.contiguous().view(-1, frame.channels)
    passing, passing_bar = passing.view(-1), passing_bar.contiguous().view(-1)
    # Cotangents from tiles, a row for each slot; unused slots are undefined.
    tile_bars = footprints.new_empty(owners.shape[0], TILE_BAR)
    tiles = starts.shape[0] - 1
    contents = (starts, owners, pair_slots, footprints, stops, picture_bar)
    if device.type == "cuda":
        kernel = block_kernels(scalar).pull_back_blocks
        of_tiles = (*contents, passing, passing_bar, tile_bars.view(-1))
        launch(kernel, tiles * TILE_PIXELS, device, frame, *of_tiles, block_dim=TILE_PIXELS)
    else:
        of_tiles = (*contents, passing.clone(), passing * passing_bar, tile_bars)
        launch(tile_kernels(scalar).pull_back_tiles, tiles, device, frame, *of_tiles)
    means, scales, quaternions, colours, *_ = scene
    bars = [torch.empty_like(tensor) for tensor in (means, scales, quaternions)]
    bars += [means.new_empty(means.shape[:2]), torch.empty_like(colours)]
    flat = scene.flat()
    flat_inputs = [*flat[:3], bars[3].view(-1), flat[3]]
    bars_out = [bar.view(like.shape) for bar, like in zip(bars, flat_inputs, strict=True)]
    arguments = (*flat, footprints, counts, slots, tile_bars, *bars_out)
    kernel = gaussian_kernels(scalar).pull_back_gaussians
    launch(kernel, bars[3].numel(), device, frame, *arguments)
    return bars[0], bars[1], bars[2], bars[3], bars[4]


class _Gaussians(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        means, scales, quaternions, opacities, colours, motions, intrinsics, *sizes = arguments
        scene = [means, scales, quaternions, colours, motions, intrinsics]
        picture, overflow, *saved = _gaussians(opacities, scene, *sizes)
        ctx.numbers = sizes[2:4]
        ctx.save_for_backward(*scene, *saved)
        ctx.mark_non_differentiable(overflow, saved[-1])
        ctx.set_materialize_grads(False)
        # The last one only for torch.compile, which must know every size that depends on data.
        return picture, saved[0], overflow, saved[-1]

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, picture_bar: Tensor | None, passing_bar: Tensor | None, *_: None
    ) -> tuple[Tensor | None, ...]:
        saved = list(ctx.saved_tensors)
        colours, passing = saved[3], saved[6]
        if picture_bar is None:
            picture_bar = passing.new_zeros(*passing.shape, colours.shape[-1])
        if passing_bar is None:
            passing_bar = torch.zeros_like(passing)
        bars = _gaussians_backward(picture_bar, passing_bar, saved, *ctx.numbers)
        return (*bars, *(None,) * 7)


def render_gaussians(
    means: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    colours: Tensor,
    cameras: Cameras,
    *,
    background: Tensor | None = None,
    dilation: float = DILATION,
    pairs_per_particle: int | None = None,
) -> GaussianPictures:
    """Draw 3D worlds by cameras, with a Gaussian for each particle; differentiable.

    This is 3D Gaussian splatting (Kerbl et al. 2023) with EWA's local affine projection (Zwicker et
    al. 2002): docs/mathematics.md has the formulas. Cameras have no gradients. The order by depth
    and the smallest alpha, 1/255, below which a Gaussian is cut off, have no derivatives either.

    Gaussians nearer than `cameras.near`, or with a number that is not finite, are not drawn.
    Results are the same bit for bit in every run, and in every batch.

    Args:
        means: Particle positions [length units], shape [B, N, 3].
        scales: Standard deviations along the Gaussians' own axes [length units], not negative,
            shape [B, N, 3].
        quaternions: Rotations of these axes (w, x, y, z), of any length: they are normalised; a
            zero stands for no rotation. Shape [B, N, 4].
        opacities: Alpha at each Gaussian's centre, in [0, 1], shape [B, N].
        colours: Dimensionless; F = 1 to 4 channels, shape [B, N, F], or coefficients of real
            spherical harmonics up to degree 1 for red, green and blue, shape [B, N, 4, 3], whose
            sum plus 0.5 is clipped to at least 0.
        cameras: V cameras, on the same device.
        background: Colours behind the Gaussians; the shape broadcasts to [B, V, H, W, F]. None is
            black.
        dilation: Added to both variances on the picture [pixels squared].
        pairs_per_particle: Room in pairs of a tile (16 x 16 pixels) and a Gaussian that covers it,
            for each particle of a picture. None: 8 on CUDA, where reading the needed number would
            wait for the device, and as many as needed on the CPU. A pair takes about 60 bytes.

    Returns:
        Image, alpha, and for each picture whether it lacked room for pairs.

    Raises:
        NPAError: A shape, dtype or device does not fit, or a number is out of its range; signs of
            scales are checked on the CPU only.
    """
    check_gaussians(means, scales, quaternions, opacities, colours)
    check_cameras(cameras, means, background, colours.shape[-1])
    dilation = checked_number("dilation", dilation)
    if not (math.isfinite(dilation) and dilation >= 0.0):
        raise NPAError(f"dilation must be finite and at least 0 pixels squared, got {dilation}")
    if pairs_per_particle is None:
        pairs_per_particle = PAIRS_PER_PARTICLE if means.is_cuda else 0
    elif checked_count("pairs_per_particle", pairs_per_particle) < 1:
        raise NPAError(f"pairs_per_particle must be at least 1, got {shown(pairs_per_particle)}")
    images = means.shape[0] * cameras.count
    if images * means.shape[1] * pairs_per_particle > MAX_INDEX:
        raise NPAError(
            f"pairs must stay below {MAX_INDEX} in one batch, got pairs_per_particle="
            f"{shown(pairs_per_particle)} for {images} pictures of {means.shape[1]} particles: "
            "split the batch or lower pairs_per_particle"
        )
    image, passing, overflow, _ = _Gaussians.apply(  # type: ignore[no-untyped-call]
        *(tensor.contiguous() for tensor in (means, scales, quaternions, opacities, colours)),
        cameras.world_to_camera.to(means.dtype).contiguous(),
        cameras.intrinsics.to(means.dtype).contiguous(),
        cameras.width,
        cameras.height,
        constant(cameras.near),
        dilation,
        int(pairs_per_particle),
    )
    if background is not None:
        image = image + passing[..., None] * background
    return GaussianPictures(image, 1.0 - passing, overflow)
