"""Slots: what the lanes of one particle share in a CUDA block's fast memory.

A slot holds a short list of neighbours: first their numbers as they are found, then each with its
weights; at the end, the row of perception that came of them, on its way out. Everything here is
native CUDA, in float32: plain Warp has no votes among lanes and no memory shared by a few threads.
Votes are of whole warps, all of whose threads must therefore take the same way: a vote of a few
lanes would make the groups of a warp run one after another.
"""

import functools
from types import SimpleNamespace

import warp as wp

from npa_envs.kernels.cuda.warps import CUDA_BLOCK

SLOT_ENTRIES = 32
"""Neighbours that a slot has room for; longer neighbourhoods are summed in several rounds."""

SHARE_OF_LIST = 2
"""A lane of several has room for so many times its share of a list."""

_ADDRESS = """
    __shared__ __align__(16) unsigned char slots[{slots} * {bytes}];
    return (unsigned)__cvta_generic_to_shared(slots + threadIdx.x / {lanes} * {bytes});
"""

_APPEND = """
    const unsigned lanes = (({lanes} == 32 ? 0u : 1u << {lanes}) - 1u)
        << (threadIdx.x & 31u & ~({lanes}u - 1u));
    const unsigned before = lanes & ((1u << (threadIdx.x & 31u)) - 1u);
    const unsigned votes = __ballot_sync(~0u, accepted);
    if (accepted) {{
        const unsigned entry = count + __popc(votes & before);
        const unsigned place = slot + {first_number} + {number_stride} * entry;
        *reinterpret_cast<int*>(__cvta_shared_to_generic(place)) = number;
    }}
    return count + __popc(votes & lanes);
"""

_NUMBER = """
    const unsigned place = slot + {first_number} + {number_stride} * entry;
    return *reinterpret_cast<const int*>(__cvta_shared_to_generic(place));
"""

_PUT = """
    float4 packed;
    packed.x = smooth;
    packed.y = kernel[0];
    packed.z = kernel[1];
    packed.w = {last};
    *reinterpret_cast<float4*>(__cvta_shared_to_generic(slot + 16 * entry)) = packed;
    {put_number}
"""

_GET = """
    const float4 packed =
        *reinterpret_cast<const float4*>(__cvta_shared_to_generic(slot + 16 * entry));
    wp::vec_t<{words}, float> result;
    result[0] = packed.x;
    result[1] = packed.y;
    result[2] = packed.z;
    result[3] = packed.w;
    {get_number}
    return result;
"""

_LIST_ADDRESS = """
    __shared__ unsigned short lists[{room} * {block}];
    return (unsigned)__cvta_generic_to_shared(lists + threadIdx.x);
"""

# As assembly, so that loads of global memory may be moved ahead of it, and without branches.
_LIST_APPEND = """
    asm volatile(
        "{{ .reg .pred near, kept;\\n"
        "setp.gt.f32 near, %1, 0f00000000;\\n"
        "setp.lt.and.u32 kept, %0, %2, near;\\n"
        "@kept st.shared.u16 [%0], %3;\\n"
        "@near add.u32 %0, %0, %4; }}"
        : "+r"(place)
        : "f"(weight), "r"(first + 2 * {block} * {room}), "h"((short)step), "n"(2 * {block}));
    return place;
"""

# Each lane's entries follow those of the lanes before it.
_LIST_LEAVE = """
    int length = (place - first) / (2 * {block});
    if (length > {room}) length = {capacity} + 1;
    int end = length;
    #pragma unroll
    for (int offset = 1; offset < {lanes}; offset *= 2) {{
        const int before = __shfl_up_sync(~0u, end, offset, {lanes});
        if (threadIdx.x % {lanes} >= offset) end += before;
    }}
    const int total = {lanes} > 1 ? __shfl_sync(~0u, end, {lanes} - 1, {lanes}) : length;
    if (row < 0 || total > {capacity}) return total;
    short* to = lists.data + (size_t)(row / 32) * (32 * {capacity}) + row % 32;
    for (int entry = 0; entry < length; ++entry) {{
        short step;
        asm volatile("ld.shared.u16 %0, [%1];" : "=h"(step) : "r"(first + 2 * {block} * entry));
        to[32 * (end - length + entry)] = step;
    }}
    return total;
"""

_LIST_STEP = """
    return lists.data[(size_t)(row / 32) * (32 * {capacity}) + row % 32 + 32 * entry];
"""

_STAGE = """
    constexpr unsigned bytes = sizeof(value) % 16 == 0 ? 16 : sizeof(value) % 8 == 0 ? 8 : 4;
    struct alignas(bytes) Chunk {{ unsigned part[bytes / 4]; }};
    const unsigned* from = reinterpret_cast<const unsigned*>(&value);
    #pragma unroll
    for (unsigned i = 0; i < sizeof(value) / bytes; ++i) {{
        Chunk chunk;
        #pragma unroll
        for (unsigned k = 0; k < bytes / 4; ++k) chunk.part[k] = from[bytes / 4 * i + k];
        *reinterpret_cast<Chunk*>(__cvta_shared_to_generic(slot + 4 * word + bytes * i)) = chunk;
    }}
"""

# A whole warp writes one slot after another, so that a row leaves in few, full transactions; in
# pairs where the channels fill their group, for then a slot holds what a row begins with.
# fminf and fmaxf return the other operand where one is NaN: such a limit changes nothing.
_WRITE = """
    __syncwarp();
    const unsigned lane = threadIdx.x & 31u;
    const unsigned slots = slot - lane / {lanes} * {bytes};
    const bool paired = ((size_t)rows.data | 4 * (size_t)rows.shape[1]) % 8 == 0;
    if (!{grouped} && state_dim == {width} && paired) {{
        char* base = reinterpret_cast<char*>(rows.data + 2 * lane);
        unsigned from = slots + 8 * lane;
        // What all slots share is computed once, not again beside each.
        asm volatile("" : "+l"(base), "+r"(from));
        #pragma unroll
        for (unsigned s = 0; s < 32 / {lanes}; ++s) {{
            const int row = __shfl_sync(~0u, destination, s * {lanes});
            float2* to = reinterpret_cast<float2*>(
                base + (unsigned long long)(unsigned)row * (4u * rows.shape[1]));
            #pragma unroll
            for (unsigned part = 0; part < ({row_words} + 63) / 64; ++part) {{
                float2 pair;
                asm volatile("ld.shared.v2.f32 {{%0, %1}}, [%2];"
                    : "=f"(pair.x), "=f"(pair.y) : "r"(from + s * {bytes} + 256 * part));
                pair.x = fminf(fmaxf(pair.x, -limit), limit);
                pair.y = fminf(fmaxf(pair.y, -limit), limit);
                if (row >= 0 && part * 64 + 2 * lane < {row_words}) to[32 * part] = pair;
            }}
        }}
        return;
    }}
    #pragma unroll
    for (unsigned s = 0; s < 32 / {lanes}; ++s) {{
        const int row = __shfl_sync(~0u, destination, s * {lanes});
        const int first = {grouped} ? __shfl_sync(~0u, group, s * {lanes}) * {width} : 0;
        float* to = rows.data + (size_t)(unsigned)row * (unsigned)rows.shape[1];
        #pragma unroll
        for (unsigned part = 0; part < ({row_words} + 31) / 32; ++part) {{
            const int word = part * 32 + lane;
            int channel = word;
            int column = word + first;
            if (word >= {width}) {{
                channel = word - {width};
                column = state_dim + channel + first;
            }}
            if (word >= 2 * {width}) {{
                const int component = word - 2 * {width};
                channel = component / {dims};
                column = 2 * state_dim + component + first * {dims};
            }}
            if (word < {row_words} && row >= 0 && channel + first < state_dim) {{
                const float value = *reinterpret_cast<const float*>(
                    __cvta_shared_to_generic(slots + s * {bytes} + 4 * word));
                to[column] = fminf(fmaxf(value, -limit), limit);
            }}
        }}
    }}
"""


@functools.cache
def make_slots(
    space_dim: int, width: int, lanes: int, state_gradient: bool, grouped: bool
) -> SimpleNamespace:
    """Return the Warp functions on slots of one variant.

    Args:
        space_dim: Space dimension D.
        width: Channels of a group.
        lanes: Lanes of a particle.
        state_gradient: Whether a row holds the state gradient.
        grouped: Whether channels come in several groups.
    """
    vector = wp.types.vector(space_dim, wp.float32)
    entry_type = wp.types.vector(space_dim + 2, wp.float32)
    flat = space_dim == 2
    row_words = width * (2 + space_dim * state_gradient)
    # The odd 16 bytes spread the slots of a warp over the memory's banks.
    list_bytes = SLOT_ENTRIES * (16 if flat else 20)
    names = {
        "lanes": lanes,
        "slots": CUDA_BLOCK // lanes,
        "bytes": max(list_bytes, 4 * row_words) + 16,
        "first_number": 12 if flat else 16 * SLOT_ENTRIES,
        "number_stride": 16 if flat else 4,
        "words": space_dim + 2,
        "width": width,
        "row_words": row_words,
        "grouped": int(grouped),
        "dims": space_dim,
        "last": "__int_as_float(number)" if flat else "kernel[2]",
        "put_number": "",
        "get_number": "",
    }
    if not flat:
        number = "*reinterpret_cast<int*>(__cvta_shared_to_generic(slot + {first} + 4 * entry))"
        number = number.format(first=names["first_number"])
        names["put_number"] = f"{number} = number;"
        names["get_number"] = f"result[4] = __int_as_float({number});"

    @wp.func_native(_ADDRESS.format(**names))
    def slot_address() -> wp.uint32: ...

    @wp.func_native(_APPEND.format(**names))
    def append_number(
        slot: wp.uint32, count: wp.int32, accepted: wp.bool, number: wp.int32
    ) -> wp.int32: ...

    @wp.func_native(_NUMBER.format(**names))
    def number_at(slot: wp.uint32, entry: wp.int32) -> wp.int32: ...

    @wp.func_native(_PUT.format(**names))
    def put_entry(
        slot: wp.uint32, entry: wp.int32, smooth: wp.float32, kernel: vector, number: wp.int32
    ): ...

    @wp.func_native(_GET.format(**names))
    def entry_at(slot: wp.uint32, entry: wp.int32) -> entry_type: ...

    @wp.func_native(_WRITE.format(**names))
    def write_rows(
        slot: wp.uint32,
        destination: wp.int32,
        group: wp.int32,
        state_dim: wp.int32,
        limit: wp.float32,
        rows: wp.array(dtype=wp.float32, ndim=2),
    ): ...

    return SimpleNamespace(
        slot_address=slot_address,
        append_number=append_number,
        number_at=number_at,
        put_entry=put_entry,
        entry_at=entry_at,
        write_rows=write_rows,
    )


@functools.cache
def make_lists(capacity: int, lanes: int = 1) -> SimpleNamespace:
    """Return the Warp functions on lists of neighbours, which the lanes of a particle make.

    A list holds the steps to neighbours in the sorted order, in 16 bits. It is gathered in fast
    memory and left in an array: 32 particles together, first entries first.

    Args:
        capacity: Neighbours that a list has room for; more are counted, but not all are kept.
        lanes: Lanes of a particle; whole warps must leave their lists together.
    """
    room = min(capacity, SHARE_OF_LIST * capacity // lanes)
    names = {"capacity": capacity, "block": CUDA_BLOCK, "lanes": lanes, "room": room}

    @wp.func_native(_LIST_ADDRESS.format(**names))
    def list_address() -> wp.uint32: ...

    @wp.func_native(_LIST_APPEND.format(**names))
    def append_step(
        first: wp.uint32, place: wp.uint32, weight: wp.float32, step: wp.int32
    ) -> wp.uint32: ...

    @wp.func_native(_LIST_LEAVE.format(**names))
    def leave_list(
        first: wp.uint32, place: wp.uint32, row: wp.int32, lists: wp.array(dtype=wp.int16)
    ) -> wp.int32: ...

    @wp.func_native(_LIST_STEP.format(**names))
    def step_at(lists: wp.array(dtype=wp.int16), row: wp.int32, entry: wp.int32) -> wp.int32: ...

    return SimpleNamespace(
        list_address=list_address,
        append_step=append_step,
        leave_list=leave_list,
        step_at=step_at,
    )


@wp.func_native("return __float_as_int(word);")
def as_number(word: wp.float32) -> wp.int32:
    """The integer that was packed into a word."""
    ...


@wp.func_native("return __int_as_float(number);")
def as_word(number: wp.int32) -> wp.float32:
    """An integer packed into a word."""
    ...


@functools.cache
def make_stage(value_type: type) -> wp.Function:
    """Return a Warp function that puts a value into a slot, a number of words from its beginning.

    Args:
        value_type: A vector or matrix type of float32.
    """

    @wp.func_native(_STAGE.format())
    def stage(slot: wp.uint32, word: wp.int32, value: value_type): ...

    return stage


@wp.func_native("return rsqrtf(value);")
def inverse_root(value: wp.float32) -> wp.float32:
    """1 / sqrt(value), two units in the last place off at most."""
    ...


@wp.func_native("""
    float length, inverse;
    asm("sqrt.rn.f32 %0, %1;" : "=f"(length) : "f"(squared));
    const float one_plus = 1.0f + length;
    const float excess = one_plus - 1.0f;
    asm("rcp.rn.f32 %0, %1;" : "=f"(inverse) : "f"(excess));
    return excess > 0.0f ? logf(one_plus) * inverse : 1.0f;
""")
def log_scale_of_square(squared: wp.float32) -> wp.float32:
    """L(v) / v of the logarithmic scaling, from v . v: log(1 + |v|) / |v|."""
    ...


@wp.func_native("return fminf(fmaxf(value, -limit), limit);")
def within(value: wp.float32, limit: wp.float32) -> wp.float32:
    """The value clipped to plus and minus a limit; as it is if the limit is NaN."""
    ...
