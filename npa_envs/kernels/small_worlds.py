"""Cell lists of small worlds on CUDA: a block sorts a world, all of it in fast memory.

The same order as that of `cells`, in one launch in place of six: particles are counted by cell,
the counts are added up, particles take provisional places by arrival, and ranks among indices
replace those.
"""

import functools

import warp as wp

from npa_envs.kernels.domain import domain_types, kernel_module
from npa_envs.kernels.lanes import make_wide_load
from npa_envs.kernels.slots import CUDA_BLOCK, thread_number

LARGEST_WORLD = 1024
"""Particles that a block has room for."""

LARGEST_GRID = 4096
"""Cells that a block has room for."""

# Counts, later starts, of cells; then of each particle its cell, its arrival there, and the
# particle of each provisional place.
_MEMORY = f"""
    __shared__ struct {{
        int starts[{LARGEST_GRID} + 1];
        int sums[{CUDA_BLOCK} / 32];
        unsigned short cells[{LARGEST_WORLD}];
        unsigned short arrivals[{LARGEST_WORLD}];
        unsigned short members[{LARGEST_WORLD}];
    }} memory;
    return (unsigned long long)&memory;
"""

_VIEW = f"""
    struct Memory {{
        int starts[{LARGEST_GRID} + 1];
        int sums[{CUDA_BLOCK} / 32];
        unsigned short cells[{LARGEST_WORLD}];
        unsigned short arrivals[{LARGEST_WORLD}];
        unsigned short members[{LARGEST_WORLD}];
    }};
    Memory& memory = *reinterpret_cast<Memory*>(address);
"""

_CLEAR = """
    for (int cell = threadIdx.x; cell < cell_count; cell += blockDim.x) memory.starts[cell] = 0;
    __syncthreads();
"""

_ARRIVE = """
    memory.cells[particle] = cell;
    memory.arrivals[particle] = atomicAdd(&memory.starts[cell], 1);
"""

# A thread adds up some adjacent cells, a warp its threads, and every thread the warps before it.
_ADD_UP = """
    __syncthreads();
    const int share = (cell_count + blockDim.x - 1) / blockDim.x;
    const int begin = min((int)threadIdx.x * share, cell_count);
    const int end = min(begin + share, cell_count);
    int sum = 0;
    for (int cell = begin; cell < end; ++cell) sum += memory.starts[cell];
    int before = sum;
    #pragma unroll
    for (unsigned offset = 1; offset < 32; offset <<= 1) {
        const int other = __shfl_up_sync(~0u, before, offset);
        if ((threadIdx.x & 31u) >= offset) before += other;
    }
    if ((threadIdx.x & 31u) == 31u) memory.sums[threadIdx.x / 32] = before;
    before -= sum;
    __syncthreads();
    for (unsigned warp = 0; warp < threadIdx.x / 32; ++warp) before += memory.sums[warp];
    for (int cell = begin; cell < end; ++cell) {
        const int count = memory.starts[cell];
        memory.starts[cell] = before;
        starts.data[first_cell + cell] = first_particle + before;
        before += count;
    }
    if (threadIdx.x == blockDim.x - 1) memory.starts[cell_count] = before;
    __syncthreads();
"""

_PLACE = """
    memory.members[memory.starts[memory.cells[particle]] + memory.arrivals[particle]] = particle;
"""

_RANKED = """
    const int particle = memory.members[place];
    const int cell = memory.cells[particle];
    const int begin = memory.starts[cell];
    const int end = memory.starts[cell + 1];
    int ranked = begin;
    for (int other = begin; other < end; ++other) ranked += memory.members[other] < particle;
    return wp::vec_t<3, int>(ranked, particle, cell);
"""


@wp.func_native(_MEMORY)
def block_memory() -> wp.uint64:
    """The block's memory."""
    ...


@wp.func_native(_VIEW + _CLEAR)
def clear_counts(address: wp.uint64, cell_count: wp.int32):
    """Set the counts of all cells to zero."""
    ...


@wp.func_native(_VIEW + _ARRIVE)
def arrive(address: wp.uint64, particle: wp.int32, cell: wp.int32):
    """Count a particle in its cell."""
    ...


@wp.func_native(_VIEW + _ADD_UP)
def add_up_counts(
    address: wp.uint64,
    cell_count: wp.int32,
    first_cell: wp.int32,
    first_particle: wp.int32,
    starts: wp.array(dtype=wp.int32),
):
    """Turn counts into starts, and write them from `first_cell` on."""
    ...


@wp.func_native(_VIEW + _PLACE)
def place_arrived(address: wp.uint64, particle: wp.int32):
    """Give a particle its provisional place."""
    ...


@wp.func_native("__syncthreads();")
def meet_block():
    """Wait until the whole block is here, and sees what it wrote."""
    ...


@wp.func_native(_VIEW + _RANKED)
def ranked_at(address: wp.uint64, place: wp.int32) -> wp.vec3i:
    """Final place, number and cell of the particle at a provisional place."""
    ...


@functools.cache
def sort_small_worlds(space_dim: int) -> wp.Kernel:
    """Return the kernel that sorts worlds of float32, a block of threads for each."""
    scalar = wp.float32
    types = domain_types(space_dim, scalar)
    vector, Domain = types.vector, types.Domain
    cell_of, cell_index = types.cell_of, types.cell_index
    load_vector = make_wide_load(vector, scalar)

    @wp.kernel(enable_backward=False, module=kernel_module("small_worlds", space_dim, scalar))
    def sort_worlds(
        domain: Domain,
        particle_count: wp.int32,
        positions: wp.array(dtype=vector),
        # outputs
        starts: wp.array(dtype=wp.int32),
        source: wp.array(dtype=wp.int32),
        sorted_cell: wp.array(dtype=wp.int32),
        sorted_positions: wp.array(dtype=vector),
    ):
        """Sort every world by cell, then index; write where every cell starts."""
        thread = thread_number()
        world = thread / wp.static(CUDA_BLOCK)
        lane = thread - world * wp.static(CUDA_BLOCK)
        first_particle = world * particle_count
        first_cell = world * domain.cell_count
        memory = block_memory()
        clear_counts(memory, domain.cell_count)
        for i in range(lane, particle_count, wp.static(CUDA_BLOCK)):
            position = load_vector(positions, first_particle + i)
            arrive(memory, i, cell_index(domain, cell_of(domain, position)))
        add_up_counts(memory, domain.cell_count, first_cell, first_particle, starts)
        for i in range(lane, particle_count, wp.static(CUDA_BLOCK)):
            place_arrived(memory, i)
        meet_block()
        for k in range(lane, particle_count, wp.static(CUDA_BLOCK)):
            ranked = ranked_at(memory, k)
            place = first_particle + ranked[0]
            i = first_particle + ranked[1]
            source[place] = i
            sorted_cell[place] = first_cell + ranked[2]
            sorted_positions[place] = load_vector(positions, i)
        if thread == 0:
            starts[starts.shape[0] - 1] = positions.shape[0]

    return sort_worlds
