"""The search for neighbours: candidates in runs of cells, or a neighbour list.

On a CPU a thread serves some adjacent particles. It copies the candidates of a cell into memory of
its own, once for all its particles in that cell. Distances, and what follows from them, are then
computed for a block of candidates at a time, in vector registers; only the near ones are summed. On
CUDA a thread has one particle, and a block is one candidate.
"""

from types import SimpleNamespace

import warp as wp

from npa_envs.compile_lock import cached_under_lock
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.domain import domain_types
from npa_envs.kernels.lanes_and_memory import make_wide_load, wide_store

BLOCK, BLOCKS, PARTICLES = 16, 16, 32
"""On a CPU: candidates of a block, blocks of copied candidates, particles of a thread."""

lowest_bit = native.function("lowest_bit", bits=wp.uint32, returns=int)
"""The index of the lowest bit that is set."""


@cached_under_lock()
def make_search(
    space_dim: int,
    scalar: type,
    entry_type: type,
    on_cpu: bool,
    listed: bool = False,
    of_rows: bool = False,
) -> SimpleNamespace:
    """Return the Warp functions that find the neighbours of a particle, in cells or in a list.

    `entries` are sorted vectors that begin with a position. A thread has a `Cursor` and the arrays
    `candidates`, scalars [`memory`], with number e of all entries from e `room` on, and `indices`,
    int32 [room]. For a particle k at `position`, of the world whose first cell is `base`, they are
    used as

        cursor = restart(cursor)
        while cursor.more != 0:
            cursor = collect(..., cursor, candidates, indices)
            for first in range(0, cursor.count, block):
                offsets, squared = distances(domain, candidates, position, first)
                near = below(squared, domain.squared_eps)

    `listed`: `neighbours` has the neighbours of each particle, up to its `ends`. `of_rows`: entries
    are rows, which begin at `row_base`; those listed are found by `row_of`.
    """
    space = domain_types(space_dim, scalar)
    vector, Domain = space.vector, space.Domain
    block, together = (BLOCK, PARTICLES) if on_cpu else (1, 1)
    capacity = BLOCK * BLOCKS if on_cpu else 1
    # Up to a block beyond the last candidate is read.
    room = capacity + block
    numbers = wp.types.vector(block, scalar)
    vectors = wp.types.matrix((space_dim, block), scalar)
    load_entry, load_scalar = make_wide_load(entry_type), make_wide_load(scalar)
    load_index = make_wide_load(wp.int32)

    # Of the copied candidates: 1 + their cell if they are all of it, else 0, and their number; then
    # the next run, the rest of the present one, and whether there are more candidates.
    @wp.struct
    class Cursor:
        held: int
        count: int
        run: int
        begin: int
        end: int
        more: int

    @wp.func
    def restart(cursor: Cursor):
        """Return the cursor at the beginning of a particle's candidates."""
        cursor.run = 0
        cursor.begin = 0
        cursor.end = 0
        cursor.more = 1
        return cursor

    @wp.func
    def collect(
        domain: Domain,
        starts: wp.array[wp.int32],
        ends: wp.array[wp.int32],
        neighbours: wp.array[wp.int32],
        row_of: wp.array[wp.int32],
        row_base: int,
        row_capacity: int,
        entries: wp.array[entry_type],
        base: int,
        position: vector,
        k: int,
        cursor: Cursor,
        # outputs
        candidates: wp.array[scalar],
        indices: wp.array[wp.int32],
    ):
        """Copy the next candidates, as many as there is room for; return the cursor behind them.

        Nothing is copied if the last particle had the same cell, and all its candidates fitted.
        """
        cell = space.cell_of(domain, position)
        label = base + space.cell_index(domain, cell) + 1
        cursor.more = 0
        if label == cursor.held:
            return cursor
        runs = wp.int32(1)
        if wp.static(not listed):
            runs = space.segment_count(domain, cell)
        run = cursor.run
        begin = cursor.begin
        end = cursor.end
        count = wp.int32(0)
        while count < wp.static(capacity) and (begin < end or run < runs):
            if begin >= end:
                if wp.static(listed):
                    if k > 0:
                        begin = ends[k - 1]
                    end = ends[k]
                else:
                    first, last = space.segment_cells(domain, cell, run)
                    begin = starts[base + first]
                    end = starts[base + last]
                    if wp.static(of_rows):
                        begin -= row_base
                        end = wp.min(end - row_base, row_capacity)
                run += 1
            stop = wp.min(end, begin + wp.static(capacity) - count)
            while begin < stop:
                index = begin
                if wp.static(listed):
                    index = load_index(neighbours, begin)
                kept = wp.int32(1)
                if wp.static(listed and of_rows):
                    kept = wp.where(row_of[index] >= 0, 1, 0)
                    index = wp.max(row_of[index], 0)
                entry = load_entry(entries, index)
                for e in range(wp.static(entry_type._length_)):
                    wide_store(candidates, wp.static(e * room) + count, entry[e])
                wide_store(indices, count, index)
                count += kept
                begin += 1
        # A distance that is NaN is not near.
        c = wp.int32(0)
        while c < wp.static(block):
            wide_store(candidates, count + c, scalar(wp.static(wp.nan)))
            c += 1
        whole = cursor.run == 0 and begin >= end and run >= runs
        cursor.held = wp.where(wp.static(on_cpu and not listed) and whole, label, 0)
        cursor.count = count
        cursor.run = run
        cursor.begin = begin
        cursor.end = end
        cursor.more = wp.where(begin < end or run < runs, 1, 0)
        return cursor

    @wp.func
    def distances(domain: Domain, candidates: wp.array[scalar], position: vector, first: int):
        """Return offsets [D, block] of candidates from `first` on, and their squared lengths."""
        offsets = vectors()
        squared = numbers()
        c = wp.int32(0)
        while c < wp.static(block):
            # Not as a vector: the compiler would not compute several candidates together.
            sum = scalar(0.0)
            for d in range(wp.static(space_dim)):
                offset = load_scalar(candidates, wp.static(d * room) + first + c) - position[d]
                if domain.periodic != 0:
                    offset = space.periodic_image_along(domain, d, offset)
                offsets[d, c] = offset
                sum += offset * offset
            squared[c] = sum
            c += 1
        return offsets, squared

    below = native.function("bits_below", values=numbers, limit=scalar, returns=wp.uint32)
    """A number with a bit for each value of a block: whether it is below a limit."""

    types = {"numbers": numbers, "vectors": vectors, "Cursor": Cursor}
    memory = {"memory": entry_type._length_ * room, "room": room}
    return native.namespace(locals(), block=block, together=together, **types, **memory)
