"""One perception of all particles by this library and by others: time, memory and error.

    pip install --target peers --no-deps nvalchemi-toolkit-ops sphwarpcore
    pip install --target peers pykeops
    PYTHONPATH=peers python benchmarks/peers.py --output FILE --plot PNG

Particles are scattered uniformly in one open world (`Workload`: about 66 neighbours in 2D, 17 in
3D; 16 channels), in float32. Every call finds its neighbours anew. A call "with backward" also
computes the gradient of a random linear functional of z by the states; positions are constants, as
in the rule's training. All are called from Python in the same way; the library also runs in a CUDA
graph, which the peers' reads of counts on the host do not allow.

Errors are relative, in the Euclidean norm, against the library in float64. Memory is what the calls
take above what was there before the first [MiB]: the peak of torch's allocator
(`torch.cuda.max_memory_allocated`) plus that of the device's default memory pool, from which Warp
allocates. A peer that is not installed or fails is left out with the reason; so are the larger
worlds of one whose call took longer than `--longest`, or whose memory did not suffice.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import io
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import warp as wp
from drift import drawn_like, relative_error
from peer_calls import PEERS, Peer
from scripts import script_facts, script_parser

from npa_envs.atomic_files import write_bytes, write_text
from npa_envs.checks import check_device
from npa_envs.measure.benchmark_records import table_text
from npa_envs.measure.plots import legend_of, new_figure, number_plainly, png
from npa_envs.measure.speed.timing import Timing, Workload, synchronize, timed
from npa_envs.ops import perceive, perception_fields
from npa_envs.runtime import quiet_warp, start_warp
from npa_envs.world.cuda_graph import capture

SIZES = (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000)
"""Particles of the worlds."""


@dataclass(frozen=True)
class PeerRow:
    """A call's time [µs], its memory [MiB] (None on a CPU) and its relative error."""

    peer: str
    backward: bool
    """Whether the gradient by the states is computed too; the error is then its error."""
    space_dim: int
    particles: int
    time_us: Timing
    memory_mib: float | None
    error: float
    leaves_out: str


def pool(device: torch.device, *, restart: bool = False) -> tuple[int, int]:
    """Return what is used of the device's default memory pool, and the peak since a restart [B]."""
    if restart:
        driver, number = ctypes.CDLL("libcuda.so.1"), ctypes.c_int()
        handle, zero = ctypes.c_void_p(), ctypes.c_uint64(0)
        used_mem_high = 8  # CU_MEMPOOL_ATTR_USED_MEM_HIGH; zero sets it to what is used
        codes = [
            driver.cuDeviceGet(ctypes.byref(number), device.index or 0),
            driver.cuDeviceGetDefaultMemPool(ctypes.byref(handle), number),
            driver.cuMemPoolSetAttribute(handle, used_mem_high, ctypes.byref(zero)),
        ]
        if any(codes):
            raise RuntimeError(f"the peak of the memory pool cannot be set to zero: {codes}")
    where = wp.device_from_torch(device)
    return wp.get_mempool_used_mem_current(where), wp.get_mempool_used_mem_high(where)


def cost(
    run: Callable[[], object], device: torch.device, repeats: int, graph: bool
) -> tuple[Timing, float | None]:
    """Return a call's time, and the memory that the first and all later calls took."""
    gc.collect()
    cuda = device.type == "cuda"
    if cuda:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device) + pool(device, restart=True)[0]
    run()
    synchronize(device)
    call = capture(run, device, generator=None, warm_up=run).replay if cuda and graph else run
    time = timed(call, device, repeats)
    if not cuda:
        return time, None
    return time, (torch.cuda.max_memory_allocated(device) + pool(device)[1] - before) / 2**20


class World:
    """One world of a workload, and what the library perceives of it in float64."""

    def __init__(self, space_dim: int, particle_count: int, device: torch.device) -> None:
        workload = Workload(space_dim, 1, particle_count, 1)
        self.eps = workload.eps
        self.x, s = workload.worlds(device)
        self.s, x = s.requires_grad_(), self.x.double()
        z = perceive(x, s.double(), self.eps)
        self.weights = drawn_like(z).float()
        self.s_bar = torch.autograd.grad((z * self.weights).sum(), s)[0]
        self.z = z.detach()
        self.density = perception_fields(x, s[..., :1].detach().double(), self.eps).rho

    def call(self, peer: Peer, backward: bool) -> Any:
        """Return what a peer perceives, or the gradient of a functional of it by the states."""
        with torch.set_grad_enabled(backward):
            found = peer.run(self.x, self.s, self.eps)
            if not backward:
                return found
            loss = (found * self.weights[..., : found.shape[-1]]).sum()
            return torch.autograd.grad(loss, self.s)[0]

    def error(self, peer: Peer, backward: bool) -> float:
        """Return the relative error of `call`."""
        found = self.call(peer, backward)
        if backward:
            return relative_error(found, self.s_bar)
        found = peer.result(found, self.x, self.eps)
        expected = self.density if found.ndim == 2 else self.z[..., : found.shape[-1]]
        return relative_error(found, expected)


def peer_rows(
    names: Sequence[str],
    space_dim: int,
    sizes: Sequence[int],
    device: torch.device,
    left_out: dict[str, str],
    *,
    repeats: int = 7,
    longest: float = 1.0,
) -> list[PeerRow]:
    """Return rows of growing worlds; `left_out` receives what was not measured, and why."""
    rows: list[PeerRow] = []
    for size, backward, name in itertools.product(sorted(sizes), (False, True), names):
        peer, what = PEERS[name], f"{name}, {space_dim}D{', with backward' if backward else ''}"
        fits = space_dim in peer.space_dims and (peer.differentiable or not backward)
        if what in left_out or not fits or (peer.graph and device.type == "cpu"):
            continue
        try:
            world = _world(space_dim, size, device)
            with quiet_warp(), contextlib.redirect_stdout(io.StringIO()):
                run = functools.partial(world.call, peer, backward)
                time, memory = cost(run, device, repeats, peer.graph)
                error = world.error(peer, backward)
        except Exception as reason:  # Whatever another library raises is a finding, not ours.
            text = (str(reason).strip().splitlines() or [""])[0][:200]
            left_out[what] = f"from {size} particles: {type(reason).__name__}: {text}"
            continue
        given = (name, backward, space_dim, size, time, memory, error, peer.leaves_out)
        rows.append(PeerRow(*given))
        print(what, size, time, memory, f"{error:.2g}", flush=True)
        if time.median > longest * 1e6:
            left_out[what] = f"beyond {size} particles: a call took {time.median / 1e6:.2g} s"
    return rows


@functools.lru_cache(maxsize=1)
def _world(space_dim: int, particle_count: int, device: torch.device) -> World:
    """Return the world of a size, once for all peers."""
    return World(space_dim, particle_count, device)


def draw(rows: Sequence[PeerRow]) -> Any:
    """Return the figure, 2D above 3D: time, forward and with backward, and the latter's memory."""
    space_dims = sorted({row.space_dim for row in rows})
    columns = 2 if rows[0].memory_mib is None else 3
    figure, panels = new_figure(len(space_dims), columns, (11.0, 0.8 + 2.9 * len(space_dims)))
    measured = {row.peer for row in rows}
    for across, space_dim in zip(panels, space_dims, strict=True):
        for column, panel in enumerate(across):
            for number, name in enumerate(PEERS):
                if name not in measured:
                    continue
                key = (name, column > 0, space_dim)
                found = [r for r in rows if (r.peer, r.backward, r.space_dim) == key]
                ours = PEERS[name].run is perceive
                style = {"color": "black" if ours else f"C{number}", "lw": 2.4 if ours else 1.2}
                style["ls"] = ":" if PEERS[name].graph else "-"
                values = [r.memory_mib if column == 2 else r.time_us.median / 1e3 for r in found]
                sizes = [row.particles for row in found]
                panel.plot(sizes, values, marker="o", ms=3, label=name, **style)
            panel.set(xscale="log", yscale="log", xlabel="particles")
            panel.set_ylabel("memory [MiB]" if column == 2 else "time [ms]")
            panel.set_title(f"{space_dim}D, {'with backward' if column else 'forward'}")
            panel.grid(alpha=0.3)
            for axis in (panel.xaxis, panel.yaxis):
                number_plainly(axis)
    legend_of(figure, panels[0][0], ncols=5, fontsize=9)
    return figure


def main() -> None:
    """Measure, print, write and draw."""
    parser = script_parser(__doc__)
    parser.add_argument("--peers", nargs="+", choices=list(PEERS), default=list(PEERS))
    parser.add_argument("--space-dims", nargs="+", type=int, choices=(2, 3), default=[2, 3])
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES), help="particles")
    parser.add_argument("--repeats", type=int, default=7, help="most readings of a time")
    parser.add_argument("--longest", type=float, default=1.0, help="of a call [s]: none larger")
    parser.add_argument("--plot", type=Path, help="PNG to write")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    device, left_out = check_device(arguments.device), {}
    start_warp()
    rows: list[PeerRow] = []
    for space_dim in arguments.space_dims:
        options = {"repeats": arguments.repeats, "longest": arguments.longest}
        worlds = space_dim, arguments.sizes, device
        rows += peer_rows(arguments.peers, *worlds, left_out, **options)
        if arguments.output is not None:
            facts = script_facts(arguments) | {"warp": wp.__version__, "left_out": left_out}
            record = facts | {"rows": [asdict(row) for row in rows]}
            write_text(arguments.output, json.dumps(record, indent=1) + "\n")
        if arguments.plot is not None and rows:
            write_bytes(arguments.plot, png(draw(rows)))
    print(table_text(rows))
    print("\nleft out:", *(f"  {what}: {why}" for what, why in left_out.items()), sep="\n")


if __name__ == "__main__":
    main()
